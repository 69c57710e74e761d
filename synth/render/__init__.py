"""Pictures and their truth: one surface under the microscope, moved frame by frame."""
