"""Options of uv from the configuration of pip."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from install_locked import locked, uv_options

CONFIGURATION = """\
:env:.find-links='/opt/wheels'
:env:.default-timeout='180'
global.cert='/etc/ssl/certs/ca.crt'
global.constraint='/etc/constraints.txt'
global.extra-index-url='file:///a/simple\\n  https://b/simple'
global.find-links='/other'
global.index-url='https://mirror/simple'
global.no-index='true'
install.index-url='https://user:pass@mirror/simple'
"""


def test_the_environment_goes_before_the_section_of_install_and_that_before_the_global_one() -> None:
    assert [*uv_options(CONFIGURATION)] == [
        *("--default-index", "https://user:pass@mirror/simple"),
        *("--index", "file:///a/simple", "--index", "https://b/simple"),
        *("--find-links", "/opt/wheels"),
        *("--cert", "/etc/ssl/certs/ca.crt"),
        "--no-index",
    ]
    assert [*uv_options("")] == []


def test_uv_is_locked_with_hashes() -> None:
    lines = locked("uv").splitlines()
    assert lines[0].startswith("uv==")
    assert all("--hash=sha256:" in line for line in lines[1:])
    assert len(lines) > 1
