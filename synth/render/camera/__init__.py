"""The microscope camera: geometry, calibration, movement, chip and video link."""
