"""The run folder: written, read back, exported."""

from vision.run.export import export_run
from vision.run.provenance import Checksums, Origin, Parameter, describe_input
from vision.run.reading import (
    Checkpoint,
    RunFolder,
    check_outside,
    check_results,
    is_run,
    read_run,
    read_strip,
)
from vision.run.writing import FAILURES, results_folder, set_aside, write_run

__all__ = [
    "FAILURES",
    "Checkpoint",
    "Checksums",
    "Origin",
    "Parameter",
    "RunFolder",
    "check_outside",
    "check_results",
    "describe_input",
    "export_run",
    "is_run",
    "read_run",
    "read_strip",
    "results_folder",
    "set_aside",
    "write_run",
]
