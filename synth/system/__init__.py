"""The machine underneath: LLVM, compiled code, clocks, how commands end."""
