"""System services: LLVM, compiled code, files, configuration, timing, and errors of commands."""
