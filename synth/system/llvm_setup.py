"""Set-up of LLVM on a new machine: finds one, or installs Debian's where permitted. Never fails a build."""

from __future__ import annotations

import os
import shutil
import subprocess

from synth.system import llvm

_PACKAGE = "libllvm19"


def main() -> None:
    """Prints in one line which LLVM was found and its consequence."""
    library = llvm.find()
    if library is None and _install():
        llvm.find.cache_clear()
        library = llvm.find()
    if library is not None:
        print(f"fast renderer: LLVM at {library}")
    else:
        print(
            "fast renderer: no usable LLVM (17 or newer; Debian: apt-get install libllvm19); "
            "using scalar_rgb, which takes up to twice as long"
        )


def _install() -> bool:
    """Installs the package if there is apt and root or passwordless sudo; returns whether that succeeded."""
    if shutil.which("apt-get") is None:
        return False
    become: list[str] = []
    if os.geteuid() != 0:
        if shutil.which("sudo") is None or not _runs(["sudo", "-n", "true"]):
            return False
        become = ["sudo", "-n"]
    print(f"installing {_PACKAGE} ...", flush=True)
    install = [*become, "apt-get", "install", "-y", "-q", "--no-install-recommends", _PACKAGE]
    return _runs(install) or (_runs([*become, "apt-get", "update", "-q"]) and _runs(install))


def _runs(command: list[str]) -> bool:
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run(
        command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, timeout=900, check=False
    )
    return done.returncode == 0


if __name__ == "__main__":
    main()
