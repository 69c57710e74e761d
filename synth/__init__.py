"""Synthesis of surgical-microscope sequences with exact physical ground truth."""

import lazy_loader

# Importing this package loads nothing but this file; `__init__.pyi` lists the names and where they are.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
