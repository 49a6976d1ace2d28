"""What the command asks of the C library."""

import os
import platform
import subprocess
import sys

import pytest

FREED = """
import numpy as np
from vision.command.console import return_freed_memory

def resident_mib():
    lines = open("/proc/self/status").read().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmRSS"))) >> 10

return_freed_memory()
np.ones(2 << 20)  # the first that is freed raises the size of arrays that are kept
arrays = [np.ones(2 << 20) for _ in range(8)]
before = resident_mib()
del arrays[:-1]
print(before - resident_mib())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a setting of the GNU C library")
def test_freed_arrays_return_to_the_system():
    """A failure means that a run holds memory of arrays that it no longer has."""
    done = subprocess.run([sys.executable, "-c", FREED], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 100  # MiB of 112


def test_tables_are_formatted_in_memory_that_is_given_back():
    """A failure means that Arrow keeps some 40 MiB of a long table until the process ends."""
    code = (
        "from vision.command.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "import pyarrow\n"
        "print(pyarrow.default_memory_pool().backend_name)"
    )
    surroundings = {name: value for name, value in os.environ.items() if name != "ARROW_DEFAULT_MEMORY_POOL"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=surroundings
    )
    assert done.stdout.split()[-1] == "system"


@pytest.mark.parametrize(
    ("encoding", "shown"),
    [
        ("cp1252", "µm ± Lambda_st sigma_x DeltaF N^ T0 -1 × ×"),
        ("ascii", "um +/- Lambda_st sigma_x DeltaF N^ T0 -1 ? ?"),
    ],
)
def test_characters_that_an_encoding_lacks_are_spelled(encoding, shown):
    """A failure means that a summary that is sent to a file on Windows names its results "?"."""
    code = (
        "from vision.command.console import open_closed_streams, say\n"
        "open_closed_streams()\n"
        "say(['µm ± Λ_st σ_x ΔF N̂ 𝒯₀ −1 × ×'])"
    )
    surroundings = {**os.environ, "PYTHONIOENCODING": encoding}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, env=surroundings)
    assert done.stdout.decode(encoding).strip() == shown
