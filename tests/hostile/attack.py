"""Attack the package: run hostile inputs in processes with limits, and count how they end.

    python tests/hostile/attack.py --minutes 60 --table build/hostile.md

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
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

sys.path.insert(0, str(Path(__file__).parent))

from cases import FAMILIES, Case, cases_of

SECONDS, GIGABYTES = 120.0, 4.0
"""Limits of a case: processor time, which other programs do not change (or time without any), and memory it adds."""

ALLOWED = ("works", "refused")
ENDINGS = (*ALLOWED, "wrong", "traceback", "crash", "hang", "memory", "left behind")


@dataclass(frozen=True)
class Outcome:
    case: Case
    ending: str
    message: str

    @property
    def is_defect(self) -> bool:
        return self.ending not in ALLOWED


def attack(cases: Sequence[Case], *, seconds: float = SECONDS, gigabytes: float = GIGABYTES) -> Iterator[Outcome]:
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
        for reported, case in enumerate(self._cases):
            began_s = busy_s = self._processor_s()
            began_gb = self._resident_gb()
            busy = looked = time.monotonic()
            while True:
                lines = self._reports.read_text(encoding="utf-8").splitlines()
                if len(lines) > reported and lines[-1].endswith("]"):
                    ending, message = json.loads(lines[reported])
                    break
                if self._process.poll() is not None:
                    yield Outcome(case, "crash", f"exit {self._process.returncode}: {self._last_words()}")
                    return
                time.sleep(0.02)
                if time.monotonic() - looked < 0.5:
                    continue
                looked, used_s = time.monotonic(), self._processor_s()
                if used_s > busy_s + 0.5:
                    busy_s, busy = used_s, looked
                if used_s - began_s > seconds or looked - busy > seconds:
                    yield Outcome(case, "hang", f"{used_s - began_s:.0f} s of work, {looked - busy:.0f} s without")
                    return
                if self._resident_gb() - began_gb > gigabytes:
                    yield Outcome(case, "memory", f"more than {gigabytes:g} GB")
                    return
            yield Outcome(case, ending, message)

    def kill(self) -> None:
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def _processor_s(self) -> float:
        return self._family(lambda process: sum(process.cpu_times()[:4]))

    def _resident_gb(self) -> float:
        return self._family(lambda process: process.memory_info().rss / 1e9)

    def _family(self, measure: Callable[[psutil.Process], float]) -> float:
        total = 0.0
        with suppress(psutil.Error):
            process = psutil.Process(self._process.pid)
            for each in [process, *process.children(recursive=True)]:
                with suppress(psutil.Error):
                    total += measure(each)
        return total

    def _last_words(self) -> str:
        return " | ".join(self._log.read_text(encoding="utf-8", errors="replace").splitlines()[-5:])


def table(outcomes: Sequence[Outcome]) -> str:
    counts = {family: Counter[str]() for family in FAMILIES}
    for outcome in outcomes:
        counts[outcome.case.family][outcome.ending] += 1
    counts["all"] = sum(counts.values(), Counter[str]())
    rows = [
        " | ".join(map(str, [family, found.total(), *(found[end] for end in ENDINGS)]))
        for family, found in counts.items()
    ]
    heads = " | ".join(["inputs", "cases", *ENDINGS])
    return "\n".join([f"| {heads} |", "|---" * (len(ENDINGS) + 2) + "|", *(f"| {row} |" for row in rows)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--family", choices=FAMILIES, action="append")
    parser.add_argument("--table", type=Path)
    given = parser.parse_args()
    began, outcomes = time.monotonic(), []
    end = began + 60.0 * given.minutes
    for round_number in range(1_000_000):
        cases = [case for family in given.family or FAMILIES for case in cases_of(family, given.seed + round_number)]
        if round_number:
            cases = [case for case in cases if case.is_random]
        random.Random(round_number).shuffle(cases)
        for outcome in attack(cases):
            outcomes.append(outcome)
            if outcome.is_defect:
                print(f"{outcome.ending}: {outcome.case.name}: {outcome.message[:600]}", flush=True)
            if time.monotonic() > end:
                break
        if time.monotonic() > end:
            break
    text = table(outcomes)
    print(text)
    if given.table:
        given.table.write_text(f"{(time.monotonic() - began) / 60.0:.0f} minutes\n\n{text}\n", encoding="utf-8")
    sys.exit(any(outcome.is_defect for outcome in outcomes))


if __name__ == "__main__":
    main()
