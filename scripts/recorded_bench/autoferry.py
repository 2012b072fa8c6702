"""Boats in a harbour, measured from a ferry by radar and lidar, among land, buoys and boats without a truth.

A recording is NAME_detections.json with NAME_groundTruth.json beside it, gzipped or not: lists of as many entries.  A
detection has ``sensorID`` (1 lidar, 2 radar; cameras are not used), ``time`` (s), ``ownshipPosition`` (north and east,
m) and ``measurement`` (norths and easts from the ferry, m); its entry of the truth has ``targetID`` and ``position`` of
each boat then.

Source: Helgesen, Vasstein, Brekke & Stahl (2022), "Heterogeneous multi-sensor tracking for an autonomous surface
vehicle in a littoral environment" (CC0).
"""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from recorded_bench.tracks import Figures
from torchfra import metrics, presets
from torchfra.association import ChiSquare, Clutter
from torchfra.motion import ConstantVelocity
from torchfra.pictures import APART, BLACK, GREY
from torchfra.plotting.style import TITLE, finish, words
from torchfra.sensors import Position
from torchfra.targets import SPRT, ClutterMap, Deletion, Extent, FieldOfView, Merging, OnePoint, Stitching, Targets

METRIC = "gospa"
PARTS = (METRIC, "hota", "idf1", "followed", "followed_seen", "switches", "false_per_minute")
OWN_PRESETS = ("radar", "radar_lidar")
"""Which sensors are used; there are no others."""
STITCHING = Stitching(30.0, 80.0, probability=1 - 1e-9)
"""Seconds and metres decide: who is out of sight for so long need not have gone straight on, as its covariance says."""
PUBLISHED: dict[str, Figures] = {
    "scenario2": {"Stone Soup JPDA": 13.8, "Stone Soup JPDA, lidar too": 15.4},
    "scenario3": {"Stone Soup JPDA": 26.5, "Stone Soup JPDA, lidar too": 20.5},
    "scenario13": {"Stone Soup JPDA": 15.3, "Stone Soup JPDA, lidar too": 13.8},
    "scenario16": {"Stone Soup JPDA": 19.0, "Stone Soup JPDA, lidar too": 17.0},
}
NOTE = (
    "GOSPA with a cutoff of 20 m and order 2, the mean over the radar's scans; followed is the share of them in which "
    "boats are, the mean over boats, and followed_seen that of scans by whose time a sensor that is used has measured "
    "within 12 m of the boat since the scan before. Stone Soup 1.9.1 with the same motion, noise, detection and "
    "clutter and the times as they are, by scripts/peers_targets.py --harbour: nobody has published such figures"
)
CUTOFF = 20.0
"""m, beyond which an estimate is not of a boat."""
SEEN = 12.0
"""m, from a measurement to the boat that it is taken to be of."""
LIDAR, RADAR = 1, 2
AGE = {RADAR: 0.84, LIDAR: 0.0}
"""s, by which a scan is older than its time says: the radar's, which has a turn of 1.68 s, half of that in the mean."""
Q, SPEED, FASTEST = 0.3, 3.0, 15.0
"""Of the boats: density of the process noise, m^2/s^3; standard deviation of the velocity at the start and highest
speed, m/s."""
STD, DETECTION, RATE = {RADAR: 2.0, LIDAR: 2.0}, {RADAR: 0.85, LIDAR: 0.5}, {RADAR: 4.0, LIDAR: 1.0}
"""Of each sensor: standard deviation of a position, m; probability that a boat is measured; false measurements of a
scan, in a square of ``WIDTH`` m."""
WIDTH, REACH, SPREAD = 600.0, 70.0, 2.0
"""m; how far the lidar sees boats for sure; standard deviation of a kernel of the map of clutter: what stays is off by
some metres for long, but only 1 to 2 m from scan to scan."""
EMPTY = 16.0
"""Scans without measurements with which the map begins: after 2 of them a third of what is seen first counts as land,
boats too."""


class Scan(NamedTuple):
    """The measurements of one sensor at an instant."""

    time: float
    sensor: int
    ferry: Tensor
    """``(2,)`` position of the sensor, m."""
    z: Tensor
    """``(J, 2)`` positions, m."""
    truth: Tensor
    """``(B, 2)`` of the boats."""


class Scene(NamedTuple):
    """A recording."""

    name: str
    z: list[Scan]
    """Scans in the order of their times."""
    published: Figures

    @property
    def truth(self) -> Tensor:
        """``(B, T, 2)`` of the boats at the radar's scans."""
        return torch.stack([scan.truth for scan in self.z if scan.sensor == RADAR], 1)


class Found(NamedTuple):
    """The tracks of a manager for a recording."""

    figures: Figures
    mean: Tensor
    """``(K, T, 2)`` positions at the radar's scans, m."""


def read(path: Path) -> Scene:
    """A recording.

    Raises:
        ValueError: a name or content other than that.
    """
    parts = path.name.split("_detections.json")
    if len(parts) != 2 or parts[1] not in ("", ".gz"):
        raise ValueError(f"{path}: expected NAME_detections.json or NAME_detections.json.gz, received {path.name}")
    name = parts[0]
    beside = [path.with_name(f"{name}_groundTruth.json{ending}") for ending in ("", ".gz")]
    truth = next((other for other in beside if other.exists()), None)
    if truth is None:
        raise ValueError(f"{path}: expected {beside[0].name} beside it, received none")
    detections, boats = _loaded(path), _loaded(truth)
    if len(detections) != len(boats):
        raise ValueError(f"{truth}: expected {len(detections)} entries as {path.name} has, received {len(boats)}")
    try:
        scans = list(_scans(detections, boats))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: expected detections and truths of the harbour, received {error!r}") from error
    if not any(scan.sensor == RADAR for scan in scans):
        raise ValueError(f"{path}: expected scans of the radar (sensorID 2), received none")
    return Scene(name, sorted(scans, key=lambda scan: scan.time), PUBLISHED.get(name, {}))


def manager(name: str) -> Targets:
    """Of the sensors of that name, with the one setting of all recordings, chosen on scenarios 2, 3, 13 and 16."""
    motion = ConstantVelocity(Q, continuous=True)
    radar, lidar = (
        presets.jpda(
            motion, Position(STD[sensor]), clutter=Clutter(WIDTH**2, rate=RATE[sensor]), detection=DETECTION[sensor],
            gate=ChiSquare(0.99999), permutations=False,
        )
        for sensor in (RADAR, LIDAR)
    )  # fmt: skip
    both = name == "radar_lidar"
    return Targets(
        radar, birth=OnePoint(SPEED), confirmation=SPRT(false=1e-4), deletion=Deletion(4, speed=FASTEST),
        merging=Merging(), extent=Extent(two=0.8), clutter_map=ClutterMap(SPREAD, 60.0, EMPTY), stitching=STITCHING,
        sensors={"lidar": lidar} if both else None, views={"lidar": FieldOfView(REACH)} if both else None,
    )  # fmt: skip


def scans_of(name: str, scene: Scene) -> list[Scan]:
    """The scans by the sensors of that name."""
    return [scan for scan in scene.z if scan.sensor == RADAR or name == "radar_lidar"]


def follow(name: str, scene: Scene) -> Found:
    """Boats that are followed by the sensors of that name, and how well.

    What is said at a time is of all scans that have come by then, in the order in which they were measured, and
    predicted from the newest of them.
    """
    targets, used = manager(name), {RADAR: None, LIDAR: "lidar"}
    scans = sorted(scans_of(name, scene), key=_measured_at)
    asked = [scan.time for scan in scene.z if scan.sensor == RADAR]
    state, last, shown = targets.init(), _measured_at(scans[0]), []
    with torch.no_grad():
        for scan, after in zip(scans, [*map(_measured_at, scans[1:]), math.inf], strict=True):
            now = _measured_at(scan)
            state, last = targets.step(state, scan.z, dt=now - last, u=scan.ferry, sensor=used[scan.sensor]), now
            while len(shown) < len(asked) and asked[len(shown)] < after:
                moved = targets.filter.motion(state.confirmed.mean, scan.z.new_tensor(asked[len(shown)] - now))
                shown.append(dict(zip(state.identity.tolist(), moved[:, :2], strict=True)))
    identities = sorted({identity for there in shown for identity in there})
    nowhere = torch.full((2,), math.nan, dtype=torch.float64)
    rows = [torch.stack([there.get(identity, nowhere) for there in shown]) for identity in identities]
    mean = torch.stack(rows) if rows else nowhere.expand(1, len(shown), 2)
    return Found(figures_of(name, scene, mean), mean)


def figures_of(name: str, scene: Scene, mean: Tensor) -> Figures:
    """How well tracks ``mean (K, T, 2)`` at the radar's scans, by the sensors of that name, follow the boats."""
    states, truth, seen = slice(0, 2), scene.truth, []
    since = torch.zeros(len(truth), dtype=torch.bool)
    for scan in scans_of(name, scene):
        since = since | ((scan.truth.unsqueeze(1) - scan.z).norm(dim=-1) < SEEN).any(-1)
        if scan.sensor == RADAR:
            seen.append(since)
            since = torch.zeros_like(since)
    lives = metrics.lives(mean, truth, states, cutoff=CUTOFF)
    while_seen = truth.where(torch.stack(seen, 1).unsqueeze(-1), torch.nan)
    lives_seen = metrics.lives(mean, while_seen, states, cutoff=CUTOFF)
    minutes = (scene.z[-1].time - scene.z[0].time) / 60
    return {
        METRIC: float(metrics.gospa(mean, truth, states, cutoff=CUTOFF).distance.mean()),
        "hota": float(metrics.hota(mean, truth, states, cutoff=CUTOFF).score),
        "idf1": float(metrics.idf1(mean, truth, states, cutoff=CUTOFF).score),
        "followed": float((lives.followed / lives.length).mean()),
        "followed_seen": float((lives_seen.followed / lives_seen.length).nanmean()),
        "switches": int(lives.switches.sum()),
        "false_per_minute": float(lives.false_tracks.sum() / minutes),
    }


def picture(scenes: Iterable[Scene], found: dict[str, dict[str, Found]]) -> Figure:
    """The harbour, a row for each recording: what was measured, the ferry's way, the boats and what was followed."""
    scenes = list(scenes)
    names = list(found[scenes[0].name])
    figure = Figure(figsize=(6.5 * len(names), 6 * len(scenes)), layout="constrained")
    for row, scene in zip(figure.subplots(len(scenes), len(names), squeeze=False), scenes, strict=True):
        for axes, name in zip(row, names, strict=True):
            seen = torch.cat([scan.z for scan in scans_of(name, scene)])
            axes.plot(*seen.flip(-1).T, ".", color=GREY, markersize=2, label="measured")
            for i, boat in enumerate(scene.truth):
                axes.plot(*boat.flip(-1).T, color=BLACK, linewidth=5, alpha=0.25, label="boats" if i == 0 else None)
            ferry = torch.stack([scan.ferry for scan in scene.z])
            axes.plot(*ferry.flip(-1).T, ":", color=BLACK, label="ferry")
            for i, path in enumerate(found[scene.name][name].mean):
                axes.plot(*path.flip(-1).T, color=APART[i % len(APART)], linewidth=1.5)
            axes.set(xlabel="east, m", ylabel="north, m", aspect="equal", title=words(f"{scene.name}, {name}", TITLE))
            axes.legend(fontsize=8)
            finish(axes)
    return figure


def _measured_at(scan: Scan) -> float:
    return scan.time - AGE[scan.sensor]


def _loaded(path: Path) -> list[Any]:
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            found = json.load(file)
    except (OSError, EOFError, ValueError) as error:
        raise ValueError(f"{path}: expected a list as JSON, received {error}") from error
    if not isinstance(found, list) or not found:
        raise ValueError(f"{path}: expected a list with entries, received {type(found).__name__}")
    return found


def _scans(detections: list[Any], boats: list[Any]) -> Iterable[Scan]:
    numbers = sorted({boat["targetID"] for there in boats for boat in _listed(there)})
    for of, there in zip(detections, boats, strict=True):
        if of["sensorID"] in (LIDAR, RADAR):
            ferry = torch.tensor(of["ownshipPosition"], dtype=torch.float64)
            z = torch.tensor(of["measurement"], dtype=torch.float64).reshape(2, -1).T + ferry
            positions = {boat["targetID"]: boat["position"][:2] for boat in _listed(there)}
            truth = torch.tensor([positions.get(i, [math.nan] * 2) for i in numbers], dtype=torch.float64)
            yield Scan(float(of["time"]), of["sensorID"], ferry, z, truth)


def _listed(there: Any) -> list[Any]:
    return there if isinstance(there, list) else [there]
