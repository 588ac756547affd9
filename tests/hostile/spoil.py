"""Ways to spoil the bytes of a file."""

import random
import re

from cases import TOKENS


def flipped(data: bytes, rng: random.Random, count: int) -> bytes:
    changed = bytearray(data)
    for _ in range(count):
        changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def without_lines(data: bytes, rng: random.Random) -> bytes:
    return b"\n".join(line for line in data.split(b"\n") if rng.random() > 0.3)


def lines_twice(data: bytes, rng: random.Random) -> bytes:
    return b"\n".join(line for line in data.split(b"\n") for _ in range(1 + (rng.random() < 0.3)))


def shuffled(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    rng.shuffle(lines)
    return b"\n".join(lines)


def with_token(data: bytes, rng: random.Random) -> bytes:
    tokens = list(re.finditer(rb"-?\d[\d.e+-]*|[A-Za-z_]\w*", data))
    if not tokens:
        return data
    chosen = rng.choice(tokens)
    return data[: chosen.start()] + rng.choice(TOKENS).encode() + data[chosen.end() :]
