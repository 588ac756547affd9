"""Run the cases of a folder one after the other, and write down how each ends (see attack.py)."""

import contextlib
import fcntl
import io
import json
import os
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from pkgutil import resolve_name
from typing import Any


def command(*arguments: object) -> str:
    from sionna_partial.cli import app

    out, err = io.StringIO(), io.StringIO()
    code: Any = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            app([*map(str, arguments)], prog_name="sionna-partial")
        except SystemExit as end:
            code = end.code
    errors = [line for line in err.getvalue().splitlines() if line.lower().startswith("error: ")]
    if code == 2 and (len(errors) == 1 or "Usage:" in err.getvalue()):
        raise Refused(errors[0] if errors else err.getvalue())
    assert code in (0, None), f"exit code {code}: {err.getvalue()[-500:]}"
    return out.getvalue()


class Refused(Exception):
    """The command line refused its input as it should."""


def run(code: str, folder: Path) -> tuple[str, str]:
    import numpy as np
    from inputs import Wrong

    import sionna_partial as sp

    names = {"sp": sp, "np": np, "folder": folder, "command": command, "Path": Path, "resolve_name": resolve_name}
    try:
        exec(code, names)
    except (sp.SionnaPartialError, Refused) as error:
        message = str(error)
        return ("refused" if message.strip() else "traceback"), message
    except Wrong as error:
        return "wrong", str(error)
    except BaseException:
        return "traceback", " | ".join(traceback.format_exc().splitlines()[-4:])
    return "works", ""


def left_behind(folder: Path) -> list[Path]:
    leftovers = ((folder.rglob, ".tmp-*"), (Path(tempfile.gettempdir()).glob, "sionna_partial_*"))
    left = []
    for path in sorted(each for find, pattern in leftovers for each in find(pattern)):
        with contextlib.suppress(OSError):  # it is locked, or was removed meanwhile
            descriptor = os.open(path, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                left.append(path)
            finally:
                os.close(descriptor)
    return left


def main() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for what runs in the background
    home = Path(sys.argv[1])
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    sys.path.insert(0, str(Path(__file__).parent))
    warnings.simplefilter("ignore")
    with (home / "reports").open("a", encoding="utf-8") as reports:
        for number, (_, code) in enumerate(json.loads((home / "cases").read_text(encoding="utf-8"))):
            folder = home / f"case{number}"
            folder.mkdir()
            os.chdir(folder)
            ending, message = run(code, folder)
            left = left_behind(folder)
            if left and ending in ("works", "refused"):
                ending, message = "left behind", ", ".join(map(str, left))
            for path in left:
                shutil.rmtree(path, ignore_errors=True)
            reports.write(json.dumps([ending, message[:2000]]) + "\n")
            reports.flush()


if __name__ == "__main__":
    main()
