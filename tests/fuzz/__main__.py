"""Any number of damaged files: python -m tests.fuzz --cases 100000 --seed 7."""

import argparse
import faulthandler
import logging
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

from tests.fuzz import runs
from tests.fuzz.cases import peak_bytes, run_cases


def main() -> int:
    """Exit status 1 if a case failed; the files of those are kept."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--runs", action="store_true", help="damaged run folders in place of films")
    parser.add_argument("--keep", type=Path, help="folder for the files that failed")
    given = parser.parse_args()
    faulthandler.enable()
    warnings.simplefilter("ignore")
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    folder = given.keep or Path(tempfile.mkdtemp(prefix="fuzz-"))
    started, outcomes, failures = time.monotonic(), Counter(), 0
    cases = runs.run_cases if given.runs else run_cases
    for _, outcome, failure in cases(given.cases, given.seed, folder):
        outcomes[outcome if failure is None else "failed"] += 1
        if failure is not None:
            failures += 1
            sys.stdout.write(f"--- {failure.file}\n{failure.what}\n")
            sys.stdout.flush()
    sys.stdout.write("".join(f"{count:7d}  {outcome}\n" for outcome, count in sorted(outcomes.items())))
    seconds = time.monotonic() - started
    sys.stdout.write(
        f"{given.cases} cases, {failures} failed, {seconds:.0f} s, {peak_bytes() >> 20} MiB; {folder}\n"
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
