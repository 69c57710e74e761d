"""Pictures and their ground truth: one surface under the microscope, moved frame by frame."""
