"""Selection of the candidates that Sionna RT verifies, by bounds of their power (docs/physics.md, Power bounds)."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.checks import Progress
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.display import part_of
from sionna_partial.process import in_order, njit
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.paths import Candidates

LEVELS = 96
"""Number of levels: level 0 is the direct path alone, the last level all weaker candidates."""

_STRONGEST, _OCTAVE = -26, 2
"""Level of a power of 0 dB, and number of levels in a factor of 2."""

_NEVER = 255
"""Level of candidates without power, which may be no paths at all."""

_FOUND = 0.8
"""Expected power of the verified paths of a link, relative to the sum of bounds."""

_WRITTEN_AT_ONCE = 25_000
"""Number of candidates that one thread writes together, to bound the memory."""

_USUAL_REFLECTIONS = 3
"""Reflections beyond which the power of a path through walls is discounted."""

NO_POWER = 10.0 ** (GAIN_FLOOR_DB / 10.0)


class Listed(NamedTuple):
    """Unwritten candidates of a part of the work.

    `rx` (C,) are receivers, `bound` (C,) upper bounds of the power, infinite for the direct path, which every link
    needs. `write` returns the candidates of some rows (K,), `at_once` together. `done` is the fraction of this kind's
    work that ends here, `unlisted` (N,) or 0 the expected power of negligible candidates.
    """

    rx: NDArray[np.integer]
    bound: Floats
    write: Callable[[Indices], Candidates]
    done: float
    unlisted: Floats | float = 0.0
    at_once: int = _WRITTEN_AT_ONCE

    def parts(self, rows: Indices) -> Iterator[Indices]:
        return (rows[start : start + self.at_once] for start in range(0, len(rows), self.at_once))


class Kind(Protocol):
    """A kind of interactions between one transmitter and N receivers."""

    @property
    def name(self) -> str:
        """The noun of its paths in messages."""
        ...

    def listed(self, found: Floats) -> Iterator[Listed]:
        """List the candidates that links need whose other indirect paths have the power `found` (N,)."""
        ...


Part = tuple[str, Listed, NDArray[np.uint8]]
"""Name of a kind, candidates without bounds, and their levels (C,)."""


class Block(NamedTuple):
    """Written candidates, the finished fraction of the work, and the message."""

    candidates: Candidates
    done: float
    message: str


class Stage(NamedTuple):
    """Candidates to verify, round after round.

    `left_out` returns the expected power (N,) of the omitted candidates; its argument is the power (N,) that this stage
    found.
    """

    rounds: Iterable[Iterator[Block]]
    left_out: Callable[[Floats], Floats]


@dataclass
class Selection:
    """Candidates of some kinds; `power` (N, LEVELS) are the sums of bounds by receiver and level.

    Candidates in levels below `end` (N,) have been selected.
    """

    parts: list[Part]
    power: Floats

    def __post_init__(self) -> None:
        self.end = np.zeros(len(self.power), np.int64)

    @classmethod
    def of(cls, kinds: Sequence[Kind], found: Floats, tolerance_db: float, report: Progress) -> "Selection":
        """List the candidates that links need whose other indirect paths have the power `found` (N,)."""
        parts: list[Part] = []
        power = np.zeros((len(found), LEVELS))
        for number, kind in enumerate(kinds):
            before = found + power[:, 1:].sum(axis=1)
            own, sums = _levels(kind, before, len(kinds), number, report)
            exceeded = sums[:, -1] > missing_power(found + expected_power(power + sums), tolerance_db)
            if exceeded.any() and before.any():
                own, sums = _levels(kind, np.where(exceeded, 0.0, before), len(kinds), number, report)
            parts, power = [*parts, *own], power + sums
        return cls(parts, power)

    def needed(self, found: Floats, tolerance_db: float) -> NDArray[np.int64]:
        """Return the level (N,) below which links need candidates, for paths of the power `found` (N,)."""
        count = LEVELS - 1
        start = np.arange(len(found) + 1) * count
        first = _first_needed(start, self.power[:, :0:-1].ravel(), missing_power(found, tolerance_db))
        return LEVELS - (first - start[:-1])

    def rounds(self, found: Floats, tolerance_db: float, span: tuple[float, float]) -> Iterator[Iterator[Block]]:
        """Select candidates as if paths were as strong as their bounds, then more if `found` (N,) is less by then."""
        middle = span[0] + 0.85 * (span[1] - span[0])
        for expected, *part in ((expected_power(self.power), span[0], middle), (0.0, middle, span[1])):
            first, self.end = self.end, np.maximum(self.end, self.needed(found + expected, tolerance_db))
            yield self._blocks(first, *part)
        self.parts.clear()  # the next stage needs the memory

    def left_out(self, found: Floats) -> Floats:
        """Expect the ratio of power and bounds of the selected candidates for the others, too."""
        total, weaker = self.power[:, 1:].sum(axis=1), np.arange(LEVELS) >= self.end[:, None]
        rest = np.where(weaker, self.power, 0.0).sum(axis=1)
        ratio = found / np.maximum(total - rest, np.finfo(float).tiny)
        return np.asarray(np.where(total > rest, np.clip(ratio, 0.0, 1.0), _FOUND) * rest)

    def _blocks(self, first: NDArray[np.int64], low: float, high: float) -> Iterator[Block]:
        def chosen() -> Iterator[tuple[int, Indices]]:
            for number, (_, part, level) in enumerate(self.parts):
                rows = np.flatnonzero((level >= first[part.rx]) & (level < self.end[part.rx]))
                yield from ((number, some) for some in part.parts(rows))

        def written(item: tuple[int, Indices]) -> Block:
            number, rows = item
            name, part, _ = self.parts[number]
            return Block(part.write(rows), low + (high - low) * (number + 1) / len(self.parts), f"verifying {name}")

        yield from in_order(written, chosen())


def _levels(kind: Kind, before: Floats, kinds: int, number: int, report: Progress) -> tuple[list[Part], Floats]:
    parts, power = [], np.zeros((len(before), LEVELS))
    for part in kind.listed(before):
        level = _sorted_by_level(part.rx, part.bound, power)
        power[:, -1] += part.unlisted
        parts.append((kind.name, part._replace(bound=part.bound[:0], unlisted=0.0), level))
        report((number + part.done) / kinds, "listing paths")
    return parts, power


def stages(
    opaque: Sequence[Kind],
    through_walls: Sequence[Kind],
    found: Floats,
    tolerances_db: tuple[float, float],
    report: Progress,
) -> Iterator[Stage]:
    """Yield candidates of opaque walls, then of paths through walls, kind after kind, with a tolerance of each.

    The caller adds the power of the indirect paths that the tolerance refers to, to `found` (N,), as it verifies them.
    """
    low, share = (0.6, 0.4 / len(through_walls)) if through_walls else (1.0, 0.0)
    ends = [0.0, *(low + share * number for number in range(len(through_walls) + 1))]
    for kinds, start, end in zip([opaque, *([kind] for kind in through_walls)], ends, ends[1:], strict=False):
        tolerance_db = tolerances_db[kinds is not opaque]
        if tolerance_db == 0.0 and kinds is opaque:
            yield Stage([_every_block(kinds, len(found), end)], np.zeros_like)
            continue
        middle = start + 0.4 * (end - start)
        selection = Selection.of(kinds, found, tolerance_db, part_of(report, start, middle))
        yield Stage(selection.rounds(found, tolerance_db, (middle, end)), selection.left_out)


def _every_block(kinds: Sequence[Kind], receivers: int, end: float) -> Iterator[Block]:
    for number, kind in enumerate(kinds):
        for part in kind.listed(np.zeros(receivers)):
            for rows in part.parts(np.arange(len(part.rx))):
                yield Block(part.write(rows), end * (number + part.done) / len(kinds), f"verifying {kind.name}")


class Limits(NamedTuple):
    """Largest numbers of reflections, of reflections at walls, and of walls crossed.

    `discount` multiplies the power for each reflection at a wall beyond the third. Paths weaker than `weakest`,
    relative to their link, need not be listed.
    """

    depth: int
    reflections: int
    walls: int
    discount: float
    weakest: float

    @classmethod
    def of(cls, settings: TraceSettings, walls: int, *, directed: bool, coarse: bool = False) -> "Limits":
        """Return the limits for at most so many walls; with a directed antenna, long paths can be the strongest.

        With `coarse`, fewer paths are listed: an unknown wall material has a much larger effect.
        """
        depth = settings.max_depth
        if settings.tolerance_db == 0.0:
            return cls(depth, depth, walls, 1.0, 1e-6)
        if directed:
            return cls(depth, depth, walls, 0.1, 1e-4)
        reflections, weakest = (3, 2.5e-3) if coarse else (4, 5e-4)
        return cls(depth, min(depth, reflections), walls, 0.03, weakest)

    def min_power(self, found: Floats) -> Floats:
        return self.weakest * np.maximum(found, NO_POWER)


@njit(cache=True, borrows=True)
def discount_after(limits, reflections):
    return limits.discount ** max(0, reflections - _USUAL_REFLECTIONS)


class NeedsByDistance(NamedTuple):
    """Smallest power that matters to any receiver beyond or within some distances from the transmitter.

    Beyond `distance_m`, it is the fraction `relative` of the power in free space. Within, it is `near` times
    (wavelength / 4 pi)^2.
    """

    distance_m: Floats
    relative: Floats
    near: Floats


def needs_by_distance(tx_m: Floats, rx_m: Floats, power: Floats, wavelength_m: float) -> NeedsByDistance:
    distance_m = np.linalg.norm(rx_m - tx_m, axis=1)
    order = np.argsort(distance_m, kind="stable")
    distance_m, power = distance_m[order], power[order] * (4.0 * np.pi / wavelength_m) ** 2
    relative = np.minimum.accumulate((power * np.maximum(distance_m, 1e-3) ** 2)[::-1])[::-1].copy()
    return NeedsByDistance(distance_m, relative, np.minimum.accumulate(power))


@njit(cache=True, borrows=True)
def matters(fraction, near, needed):
    """Return whether a ray, at least `near` long, may matter to any receiver with a fraction of its power left."""
    at = np.searchsorted(needed.distance_m, near)
    if at < len(needed.distance_m) and fraction >= needed.relative[at]:
        return True
    return at > 0 and fraction >= needed.near[at - 1] * near * near


@njit(cache=True)
def _first_needed(start, power, allowed):
    """Return the first power of each receiver (N,), the weakest first, that may not be left out.

    Receiver k has the powers `start[k]` to `start[k + 1]` and may lack `allowed[k]` in all.
    """
    first = np.empty(len(allowed), np.int64)
    for k in range(len(allowed)):
        total, first[k] = 0.0, start[k + 1]
        for i in range(start[k], start[k + 1]):
            total += power[i]
            if total > allowed[k]:
                first[k] = i
                break
    return first


@njit(cache=True, nogil=True)
def _sorted_by_level(rx, bound, power):
    """Return the levels (C,) of candidates, and add their bounds to the power (N, LEVELS) of levels above 0."""
    level = np.zeros(len(rx), np.uint8)
    for c in range(len(rx)):
        if bound[c] == np.inf:
            continue
        if bound[c] <= 0.0:
            level[c] = _NEVER
            continue
        level[c] = min(max(np.ceil(_STRONGEST - _OCTAVE * np.log2(bound[c])), 1), LEVELS - 1)
        power[rx[c], level[c]] += bound[c]
    return level


def expected_power(power: Floats) -> Floats:
    return np.asarray(_FOUND * power[:, 1:].sum(axis=1))


def missing_power(found: Floats, tolerance_db: float) -> Floats:
    """Return the power (N,) that links may lack whose indirect paths have the power `found` (N,).

    The gain changes by `tolerance_db` at most; links without paths may lack power that no receiver notices.
    """
    fraction = 10.0 ** (tolerance_db / 10.0) - 1.0
    return np.maximum(fraction * found, NO_POWER - found)
