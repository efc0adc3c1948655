"""The long checks, by subject: `python tests/gate/run.py options`; without a subject all of them, one after the other.

A subject is a module of this folder with a function `main`, which prints failures and returns their number.
"""

import argparse
import importlib
import os
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
SUBJECTS = tuple(
    subject for subject in ("options", "mistakes", "good", "docs") if (FOLDER / f"{subject}.py").is_file()
)


def main() -> int:
    """Run subjects, and return 0 where nothing failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("subjects", nargs="*", metavar="SUBJECT", help=f"of {', '.join(SUBJECTS)}")
    chosen = parser.parse_args().subjects or SUBJECTS
    if unknown := set(chosen) - set(SUBJECTS):
        parser.error(f"expected subjects of {', '.join(SUBJECTS)}, got {', '.join(sorted(unknown))}")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.path[:0] = [str(FOLDER.parent.parent), str(FOLDER.parent)]
    sys.path.append(str(FOLDER.parent.parent / "training" / "papers"))
    failed = {subject: importlib.import_module(f"gate.{subject}").main() for subject in chosen}
    for subject, count in failed.items():
        print(f"{subject}: {count} failed" if count else f"{subject}: passed")
    return int(any(failed.values()))


if __name__ == "__main__":
    sys.exit(main())
