"""Transmitters and radio settings of a window: changed by hand, or found by searches."""

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from sionna_partial.apps.app.predicting import PredictionJobs, network_of
from sionna_partial.apps.app.radio import MOST_TRANSMITTERS, PRESETS, Transmitter, require_name
from sionna_partial.apps.app.state import WindowState, unused_name
from sionna_partial.arrays import Floats
from sionna_partial.checks import Progress, require, require_choice
from sionna_partial.constants import CellState
from sionna_partial.errors import SettingsError
from sionna_partial.exploration.next_views import NextViews, next_views
from sionna_partial.maps.grid import cell_centres_m, nearest_free_m
from sionna_partial.placement.placement import place_transmitter
from sionna_partial.placement.several import NetworkPlacement, place_transmitters

ROUNDING_M = 0.006
"""Positions of the picture that are nearer than this are equal [m]."""


class Radios:
    """Changes of the transmitters and radio settings of a window."""

    def __init__(self, state: WindowState, jobs: PredictionJobs) -> None:
        self._state, self._jobs = state, jobs

    def put(self, positions: Sequence[tuple[str, float, float]]) -> None:
        """Take the transmitters (name, x, y) [m] of the picture; new ones have no name yet."""
        if len(positions) > MOST_TRANSMITTERS:
            raise SettingsError(f"there are {MOST_TRANSMITTERS} transmitters already: remove one first.")
        state, found = self._state, dict[str, Transmitter]()
        for name, x_m, y_m in positions:
            old = state.transmitters.get(name)
            name = name if old else unused_name([*state.transmitters, *found])
            x_m, y_m = round(float(x_m), 2), round(float(y_m), 2)
            if old is None:
                state.chosen, found[name] = name, replace(state.new_transmitter(), x_m=x_m, y_m=y_m)
            elif max(abs(x_m - old.x_m), abs(y_m - old.y_m)) > ROUNDING_M:
                state.chosen, found[name] = name, replace(old, x_m=x_m, y_m=y_m)
            else:
                found[name] = old
        if found != state.transmitters:  # a drag of the picture moves none
            self._jobs.predict_for(found)

    def add(self) -> None:
        partial = self._state.require_map()
        free = np.argwhere(partial.state == CellState.FREE)
        require(len(free) > 0, "free cells", 0, "give a map with some.")
        x_m, y_m = nearest_free_m(partial, cell_centres_m(partial, free.mean(axis=0)))[0]
        known = ((name, each.x_m, each.y_m) for name, each in self._state.transmitters.items())
        self.put([*known, ("", x_m, y_m)])

    def change(self, name: str, new_name: str | None = None, **values: Any) -> None:
        state = self._state
        require_choice("transmitter", name, state.transmitters)
        new_name = name if new_name is None else new_name.strip()
        require_name(new_name)
        require(new_name == name or new_name not in state.transmitters, "name", new_name, "another one has it.")
        values |= {"model": ""} if "eirp_dbm" in values else {}
        changed = state.settings.powered(replace(state.transmitters[name], **values))
        state.chosen = new_name if state.chosen == name else state.chosen
        pairs = [(new_name, changed) if key == name else (key, old) for key, old in state.transmitters.items()]
        self._jobs.predict_for(dict(pairs))

    def remove(self, name: str) -> None:
        self._jobs.predict_for({each: old for each, old in self._state.transmitters.items() if each != name})

    def use_preset(self, name: str) -> None:
        require_choice("preset", name, PRESETS)
        state, values = self._state, PRESETS[name]._asdict()
        settings = replace(state.settings, **values)
        given = {"eirp_dbm": values["eirp_dbm"], "channel": ""}
        changed = {each: settings.powered(replace(old, **given)) for each, old in state.transmitters.items()}
        state.transmitters = changed
        self.set(**values)

    def set(self, **values: Any) -> None:
        """Change settings, and predict if more than the threshold changes."""
        state = self._state
        settings = replace(state.settings, **values)
        state.transmitters = {name: settings.powered(each) for name, each in state.transmitters.items()}
        state.settings = settings
        if values.keys() <= {"threshold_dbm"}:
            self._jobs.show()
        else:
            self._jobs.predict()


class Searches:
    """Searches for places and channels of transmitters, and for the next views of a robot."""

    def __init__(self, state: WindowState, jobs: PredictionJobs) -> None:
        self._state, self._jobs = state, jobs

    def place(self) -> None:
        """Move the chosen transmitter to the best place."""
        state, partial, settings = self._state, self._state.require_map(), self._state.settings
        name = state.chosen
        old = state.transmitters.get(name, state.new_transmitter())
        threshold_db = state.threshold_db([old])

        def take(position_m: Floats) -> None:
            x_m, y_m, z_m = (round(float(each), 3) for each in position_m)
            state.chosen = name or unused_name([])
            self._jobs.predict_for(state.transmitters | {state.chosen: replace(old, x_m=x_m, y_m=y_m, z_m=z_m)})

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            found = place_transmitter(
                self._jobs.model("map", partial, settings),
                threshold_db=threshold_db,
                tx_height_m=old.z_m,
                rx_height_m=settings.rx_height_m,
                progress=report,
            )
            yield functools.partial(take, found.position_m)

        self._jobs.begin(work)

    def place_several(self, goal: float, most: int) -> None:
        """Replace the transmitters by the fewest of up to `most` that cover the fraction `goal` of the floor."""
        state, partial, settings = self._state, self._state.require_map(), self._state.settings
        like = state.transmitters.get(state.chosen, state.new_transmitter())
        threshold_db = state.threshold_db([like])

        def take(found: NetworkPlacement) -> None:
            names = [f"tx{number}" for number in range(1, len(found.added) + 1)]
            places_m = [{"x_m": x_m, "y_m": y_m} for x_m, y_m, _ in found.positions_m.round(2).tolist()]
            self._jobs.predict_for(
                {name: replace(like, **at_m, channel="") for name, at_m in zip(names, places_m, strict=True)}
            )
            texts = [f"{name} {more:.0%}" for name, more in zip(names, found.added, strict=True)]
            reached = "" if found.score >= goal else f" The goal of {goal:.0%} needs more than {most}, or more power."
            state.action_warnings.append(
                f"Expected covered floor {found.score:.0%}; each adds: {', '.join(texts)}.{reached}"
            )

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            found = place_transmitters(
                self._jobs.model("map", partial, settings),
                most,
                goal=goal,
                threshold_db=threshold_db,
                tx_height_m=like.z_m,
                rx_height_m=settings.rx_height_m,
                progress=report,
            )
            yield functools.partial(take, found)

        self._jobs.begin(work)

    def plan_channels(self) -> None:
        """Give each transmitter a channel of the band, so that the mean rate is large."""
        state, answer = self._state, self._jobs.final_answer
        channels, names = state.settings.channels, [*state.transmitters]
        if answer is None or answer.network is None:
            raise SettingsError("channels are planned for two or more transmitters with a fine picture: wait for it.")
        network = answer.network

        def take(found: xr.Dataset) -> None:
            plan = dict(zip(names, found["channel"].to_numpy(), strict=True))
            state.transmitters = {name: replace(old, channel=plan[name]) for name, old in state.transmitters.items()}
            before, after = (float(np.nanmean(each["rate_bit_s"])) / 1e6 for each in (network, found))
            self._jobs.take_answer(replace(answer, network=found))
            state.action_warnings = [f"Mean rate with the plan of channels {after:.0f} Mbit/s, before {before:.0f}."]

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.2, "planning channels")
            yield functools.partial(take, network_of(answer, network.attrs["tx_power_dbm"], channels))

        self._jobs.begin(work)

    def find_views(self) -> None:
        """Find the places from which a robot learns most about the coverage."""
        state, partial, settings = self._state, self._state.require_map(), self._state.settings
        tx_m = [*state.require_positions_m().values()]
        threshold_db = state.threshold_db([*state.transmitters.values()])

        def take(views: NextViews) -> None:
            state.views = views
            if self._jobs.final_answer is None:
                self._jobs.predict()

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            model = self._jobs.model("map", partial, settings)
            views = next_views(model, tx_m, threshold_db=threshold_db, progress=report)
            yield functools.partial(take, views)

        self._jobs.begin(work)
