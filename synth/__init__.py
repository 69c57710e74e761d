"""Synthesis of surgical-microscope sequences with exact physical ground truth."""

import lazy_loader

# Importing this package loads only this file; `__init__.pyi` lists the public names and their modules.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
