"""The report on a machine, on systems that lack what Linux has."""

import subprocess
import sys
from pathlib import Path

import pytest

LACKING = {
    "Windows": "sys.modules['fcntl'] = sys.modules['resource'] = None; del os.getuid, "
    "os.sched_getaffinity, os.sysconf;"
    "platform.system = lambda: 'Windows'",
    "macOS": "del os.sched_getaffinity; platform.system = lambda: 'Darwin'",
}


@pytest.mark.slow
@pytest.mark.parametrize("system", LACKING)
def test_other_systems_are_named_as_unsupported(system: str, tmp_path: Path) -> None:
    code = f"import sys, os, platform; {LACKING[system]}\nsys.argv = ['synth', 'doctor', {str(tmp_path)!r}]\n"
    code += "import runpy; runpy.run_module('synth', run_name='__main__')"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    lines = process.stdout.splitlines()
    assert any(line.startswith("LACK system") for line in lines)
    assert any(line.startswith("LACK fcntl") for line in lines) == (system == "Windows")
