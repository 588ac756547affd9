"""Install requirements.lock beside this interpreter: by uv, in a tenth of pip's time, or else by pip.

Uv does not read pip's configuration: indexes, links, trusted hosts and certificates are handed on. Constraints are not:
uv refuses them beside hashes, and every version is locked.
"""

import ast
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

LOCK = Path(__file__).with_name("requirements.lock")
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
CHECKED = ["--no-deps", "--only-binary", ":all:", "--require-hashes"]

OPTIONS = {
    "index-url": "--default-index",
    "extra-index-url": "--index",
    "find-links": "--find-links",
    "trusted-host": "--allow-insecure-host",
    "cert": "--cert",
    "no-index": "--no-index",
}
"""Options of pip that uv has under other names."""


def uv_options(configuration: str) -> Iterator[str]:
    """Yield the options of uv for the output of ``pip config list``: the environment goes first, then ``install.``."""
    found = dict(re.findall(r"^((?:global|install|:env:)\.[\w-]+)=(.+)$", configuration, re.MULTILINE))
    for name, option in OPTIONS.items():
        texts = (
            found[f"{section}.{name}"] for section in (":env:", "install", "global") if f"{section}.{name}" in found
        )
        for value in ast.literal_eval(next(texts, "''")).split():
            if name != "no-index":
                yield from (option, value)
            elif value.lower() in ("1", "on", "true", "yes"):
                yield option


def locked(name: str) -> str:
    """Return the lines of a package in the lock."""
    return next(iter(re.findall(rf"^{name}==(?:.*\\\n)*.*\n", LOCK.read_text(encoding="utf-8"), re.MULTILINE)))


def install_by_uv() -> bool:
    """Install uv by pip, and the rest by uv; return whether that worked."""
    with tempfile.TemporaryDirectory() as folder:
        own = Path(folder, "uv.txt")
        own.write_text(locked("uv"), encoding="utf-8")
        if subprocess.run([*PIP, "install", "--quiet", *CHECKED, "--requirement", own], check=False).returncode:
            return False
    listed = subprocess.run([*PIP, "config", "list"], check=False, capture_output=True, text=True).stdout
    uv = [str(Path(sys.executable).with_name("uv")), "pip", "install", "--quiet", "--python", sys.executable]
    # pip takes the best version of all indexes, uv the first index that has any
    options = ["--index-strategy", "unsafe-best-match", *uv_options(listed)]
    return subprocess.run([*uv, *CHECKED, *options, "--requirements", LOCK], check=False).returncode == 0


def main() -> int:
    """Install, and return the exit code of the last program."""
    if install_by_uv():
        return 0
    print("uv failed: installing by pip, which takes some minutes", file=sys.stderr)
    return subprocess.run([*PIP, "install", "--quiet", *CHECKED, "--requirement", LOCK], check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
