"""Attack the package: run hostile inputs in processes with limits, and count how they end.

    python tests/hostile/attack.py --minutes 60 --table docs/hostile.md

A case may end in two ways: the call works, or it is refused with a `SionnaPartialError` (on the command line, exit code
2 and one line that begins with "error: "). Everything else is a defect: a wrong result that the case itself detects,
another exception, a crash, a hang, too much memory, or a file left behind.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

sys.path.insert(0, str(Path(__file__).parent))

from cases import FAMILIES, Case, cases_of

SECONDS, GIGABYTES = 120.0, 4.0
"""Limits of a case: wall time, and resident memory beyond that of an idle worker."""

ALLOWED = ("works", "refused")
ENDINGS = (*ALLOWED, "wrong", "traceback", "crash", "hang", "memory", "left behind")


@dataclass(frozen=True)
class Outcome:
    """How a case ended."""

    case: Case
    ending: str
    message: str

    @property
    def is_defect(self) -> bool:
        """Whether the package did what it must not do."""
        return self.ending not in ALLOWED


def attack(cases: Sequence[Case], *, seconds: float = SECONDS, gigabytes: float = GIGABYTES) -> Iterator[Outcome]:
    """Run cases one after the other in a worker process, which is replaced when a case takes it down."""
    waiting = list(cases)
    while waiting:
        with tempfile.TemporaryDirectory(prefix="hostile_") as folder:
            worker = _Worker(Path(folder), tuple(waiting))
            try:
                for outcome in worker.outcomes(seconds, gigabytes):
                    waiting.pop(0)
                    yield outcome
            finally:
                worker.kill()


class _Worker:
    """A process that runs cases in their order, and reports the end of each."""

    def __init__(self, folder: Path, cases: Sequence[Case]) -> None:
        self._cases, self._log = cases, folder / "stderr"
        self._reports = folder / "reports"
        self._reports.touch()
        (folder / "cases").write_text(json.dumps([(each.name, each.code) for each in cases]), encoding="utf-8")
        temporary = folder / "tmp"
        temporary.mkdir()
        environment = os.environ | {"TMPDIR": str(temporary), "MPLBACKEND": "Agg", "PYTHONFAULTHANDLER": "1"}
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, str(Path(__file__).with_name("worker.py")), str(folder)],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def outcomes(self, seconds: float, gigabytes: float) -> Iterator[Outcome]:
        """Yield the outcome of each case, until one takes the process down."""
        reported, began = 0, time.monotonic()
        for case in self._cases:
            while True:
                lines = self._reports.read_text(encoding="utf-8").splitlines()
                if len(lines) > reported and lines[-1].endswith("]"):
                    ending, message = json.loads(lines[reported])
                    break
                if self._process.poll() is not None:
                    yield Outcome(case, "crash", f"exit {self._process.returncode}: {self._last_words()}")
                    return
                if time.monotonic() - began > seconds + (60.0 if reported == 0 else 0.0):
                    yield Outcome(case, "hang", f"more than {seconds:g} s")
                    return
                if self._resident_gb() > gigabytes:
                    yield Outcome(case, "memory", f"more than {gigabytes:g} GB")
                    return
                time.sleep(0.02)
            reported, began = reported + 1, time.monotonic()
            yield Outcome(case, ending, message)

    def kill(self) -> None:
        """End the process and its children."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def _resident_gb(self) -> float:
        try:
            process = psutil.Process(self._process.pid)
            family = [process, *process.children(recursive=True)]
            return float(sum(each.memory_info().rss for each in family)) / 1e9
        except psutil.Error:
            return 0.0

    def _last_words(self) -> str:
        return " | ".join(self._log.read_text(encoding="utf-8", errors="replace").splitlines()[-5:])


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a Markdown table of how many cases of each family ended how."""
    counts = {family: Counter[str]() for family in FAMILIES}
    for outcome in outcomes:
        counts[outcome.case.family][outcome.ending] += 1
    rows = [
        f"| {family} | {sum(counts[family].values())} | "
        + " | ".join(str(counts[family][end]) for end in ENDINGS)
        + " |"
        for family in FAMILIES
    ]
    total = sum(counts.values(), Counter[str]())
    rows.append(f"| all | {sum(total.values())} | " + " | ".join(str(total[end]) for end in ENDINGS) + " |")
    return "\n".join([f"| inputs | cases | {' | '.join(ENDINGS)} |", "|---" * (len(ENDINGS) + 2) + "|", *rows])


def main() -> None:
    """Run every fixed case once, and random ones until the time is up."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--family", choices=FAMILIES, action="append")
    parser.add_argument("--table", type=Path)
    given = parser.parse_args()
    end, outcomes = time.monotonic() + 60.0 * given.minutes, []
    for round_number in range(1_000_000):
        cases = [case for family in given.family or FAMILIES for case in cases_of(family, given.seed + round_number)]
        if round_number:
            cases = [case for case in cases if case.is_random]
        random.Random(round_number).shuffle(cases)
        for outcome in attack(cases):
            outcomes.append(outcome)
            if outcome.is_defect:
                print(f"{outcome.ending}: {outcome.case.name}: {outcome.message[:600]}", flush=True)
            if time.monotonic() > end and round_number:
                break
        if time.monotonic() > end:
            break
    text = table(outcomes)
    print(text)
    if given.table:
        given.table.write_text(f"# Hostile inputs\n\n`make hostile` made this table.\n\n{text}\n", encoding="utf-8")
    sys.exit(any(outcome.is_defect for outcome in outcomes))


if __name__ == "__main__":
    main()
