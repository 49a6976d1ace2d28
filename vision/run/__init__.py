"""The run folder: written, read back, exported."""

from vision.folder import check_new, check_target, plain, run_folder, whole_file, write_json
from vision.run.export import export_run
from vision.run.provenance import Checksums, Origin, Parameter, describe_input
from vision.run.reading import (
    Checkpoint,
    RunFolder,
    check_mark,
    is_run,
    read_run,
    read_strip,
)
from vision.run.writing import FAILURES, write_run

__all__ = [
    "FAILURES",
    "Checkpoint",
    "Checksums",
    "Origin",
    "Parameter",
    "RunFolder",
    "check_mark",
    "check_new",
    "check_target",
    "describe_input",
    "export_run",
    "is_run",
    "plain",
    "read_run",
    "read_strip",
    "run_folder",
    "whole_file",
    "write_json",
    "write_run",
]
