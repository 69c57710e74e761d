"""Video files: frames read and written, instrument masks, millimetres per pixel."""
