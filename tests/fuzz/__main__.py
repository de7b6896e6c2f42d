"""``python -m tests.fuzz``: many cases from a seed of one's own; prints what is wrong, one line a kind of fault."""

from __future__ import annotations

import argparse
import random
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.fuzz.cases import write_files
from tests.fuzz.runner import report, verdict


def main() -> int:
    """Run cases and count faults."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(10**9))
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--one", action="store_true", help="only the case of the seed, with its folder left")
    arguments = parser.parse_args()
    root = Path(tempfile.mkdtemp(prefix="fuzz-"))
    files = root / "files"
    files.mkdir()
    write_files(files)
    kinds: Counter[str] = Counter()
    statuses: Counter[int | None] = Counter()
    begin = time.process_time()
    for seed in range(arguments.seed, arguments.seed + (1 if arguments.one else arguments.cases)):
        folder = root / "case"
        case, ended, wrong = verdict(seed, files, folder)
        statuses[ended.status] += 1
        if wrong or arguments.one:
            where = re.findall(r'File "[^"]*/((?:arrays|magloc|adcs|sims)/[^"]+)", line (\d+)', ended.trace)
            kind = f"{wrong[0] if wrong else 'good'} {':'.join(where[-1]) if where else case.arguments[:2]}"
            kinds[kind] += 1
            if kinds[kind] == 1:
                print(report(seed, case, ended, wrong), flush=True)
        if arguments.one:
            print(root)
            return 0
        shutil.rmtree(folder)
    seconds = time.process_time() - begin
    print(f"{arguments.cases} cases from seed {arguments.seed}, {seconds:.0f} s of CPU, statuses {dict(statuses)}")
    for kind, count in kinds.most_common():
        print(f"{count:6d}  {kind}")
    shutil.rmtree(root)
    return 1 if kinds else 0


if __name__ == "__main__":
    sys.exit(main())
