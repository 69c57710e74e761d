"""Films as files: frames read and written, masks of the tool, millimetres a pixel."""
