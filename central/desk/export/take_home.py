"""Write a run's map and paths as tables in common formats: metres, seconds, radians, all digits."""

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path as FilePath
from typing import Any

import msgspec
import numpy as np

from teamslam.central.desk.evaluation.association import Place, members_of
from teamslam.central.desk.evaluation.errors import Path, associate_truth
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.results import Evaluation, MapResult
from teamslam.central.desk.paths import SmoothedPath, smoothed_paths
from teamslam.central.desk.verification.recorded import Recorded
from teamslam.central.survey import datum_of
from teamslam.team import translate
from teamslam.team.config import UNNAMED
from teamslam.team.datum import Datum
from teamslam.team.estimation.dense import diagonal_blocks
from teamslam.team.geodesy import geodetic_from_local
from teamslam.team.recording.reader import Log, LogError
from teamslam.team.shapes import Float
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import ids

MAP_COLUMNS = (
    "id", "x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2", "measurements", "frame",
)  # fmt: skip
DEGREES = ("latitude_deg", "longitude_deg")  # further columns of a map with a datum
STATE = "state"
"""Further column of a map that was compared with saved ones: moved, gone, new, unchanged."""
CLASSES = ("class", "class_probability")  # further columns of a map whose landmarks have classes
PATH_COLUMNS = (
    "t_s", "x_m", "y_m", "theta_rad", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2", "cov_xt_m_rad",
    "cov_yt_m_rad", "cov_tt_rad2",
)  # fmt: skip


@dataclass(frozen=True)
class TakenHome:
    """Contents of the tables besides the final map.

    measurements: count by landmark. classes: name and probability of a landmark's likeliest class.
    """

    paths: Mapping[str, SmoothedPath] = field(default_factory=dict)
    measurements: Mapping[int, int] = field(default_factory=dict)
    datum: Datum | None = None
    classes: Mapping[int, tuple[str, float]] = field(default_factory=dict)


def take_home(found: Recorded, progress: Callable[[str], None] = lambda _: None) -> TakenHome:
    """Compute the tables' contents."""
    config = found.central_config()[0] if "central" in found.configured else None
    maps, saved = found.of(m.FusedMap, ch.FINAL_MAP), found.saved_maps.values()
    return TakenHome(
        paths=smoothed_paths(found, progress),
        measurements=_measurement_counts(found),
        datum=None if config is None or not maps else datum_of(config, maps[-1], saved),
        classes=_landmark_classes(found, () if config is None else config.classes),
    )


def _landmark_classes(found: Recorded, names: Sequence[str]) -> Mapping[int, tuple[str, float]]:
    """Name (else number) and probability of the likeliest class of each unnamed landmark.

    P(c) ∝ Π P(reports | c) over its submaps' landmarks, for equally frequent classes.
    """
    rows: dict[Place, Float[np.ndarray, " C"]] = {}
    for submap in found.of(m.Submap, ch.SUBMAP):
        own = [each for each, _ in _detections(submap)]
        rows |= zip(own, translate.classes_of(submap, len(own)), strict=True)
    most = max((len(each) for each in rows.values()), default=0)
    sums: dict[int, Float[np.ndarray, " C"]] = {}
    for member, identity in _final_members(found):
        row = rows.get(member, np.zeros(0))
        if len(row):
            full = np.full(most, row.min())
            full[: len(row)] = row
            sums[identity] = sums.get(identity, np.zeros(most)) + full
    classes = {}
    for identity, row in sums.items():
        best = int(np.argmax(row))
        name = names[best] if best < len(names) else str(best)
        classes[identity] = name, float(1.0 / np.exp(row - row[best]).sum())
    return classes


def _measurement_counts(found: Recorded) -> Mapping[int, int]:
    counts = Counter[int]()
    for stream in found.measurements.values():
        for message in stream.values():
            if isinstance(message, m.Observations | m.Points):
                named = ids(message.ids, "ids")
                counts.update(named[named < UNNAMED].tolist())
    seen = dict(chain.from_iterable(map(_detections, found.of(m.Submap, ch.SUBMAP))))
    for member, identity in _final_members(found):
        counts[identity] += seen.get(member, 0)
    return counts


def _final_members(found: Recorded) -> Iterator[tuple[Place, int]]:
    return chain.from_iterable(map(members_of, found.of(m.FusedMap, ch.FINAL_MAP)[-1:]))


def _detections(submap: m.Submap) -> Iterator[tuple[Place, int]]:
    numbers = ids(submap.ids, "ids")
    unnamed = (numbers[numbers >= UNNAMED] - UNNAMED).tolist()
    for local, count in zip(unnamed, ids(submap.counts, "counts").tolist(), strict=True):
        yield (submap.robot, submap.incarnation, submap.sequence, local), count


def write_map(fused: MapResult, taken: TakenHome, folder: FilePath) -> list[FilePath]:
    """Write map.csv and map.json with 2 × 2 covariances."""
    datum, states = taken.datum, {each.landmark: each.state for each in fused.changes}
    upper = diagonal_blocks(fused.covariance)[:, (0, 0, 1), (0, 1, 1)].tolist()
    places = [] if datum is None else geodetic_from_local(datum, fused.means).tolist()
    columns = [*MAP_COLUMNS, *[STATE] * bool(states), *CLASSES * bool(taken.classes)]
    columns += DEGREES * (datum is not None)
    rows: list[dict[str, Any]] = []
    for k, landmark in enumerate(fused.ids.tolist()):
        count = taken.measurements.get(landmark, None if landmark >= UNNAMED else 0)
        values = [landmark, *fused.means[k].tolist(), *upper[k], count, fused.frame]
        values += [states.get(landmark)] * bool(states)
        values += taken.classes.get(landmark, (None, None)) if taken.classes else ()
        values += places[k] if places else ()
        rows.append(dict(zip(columns, values, strict=True)))
    table, data = folder / "map.csv", folder / "map.json"
    with table.open("w", encoding="utf-8", newline="") as lines:
        writer = csv.DictWriter(lines, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    whole = {
        "frame": fused.frame,
        "set": fused.digest,
        "final_map_sha256": fused.payload_sha256,
        **({} if datum is None else {"datum": msgspec.to_builtins(datum)}),
        "landmarks": [{k: v for k, v in row.items() if k != "frame"} for row in rows],
    }
    data.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")
    return [table, data]


def write_geojson(
    fused: MapResult, paths: Mapping[str, SmoothedPath], folder: FilePath, datum: Datum
) -> FilePath:
    """Write map.geojson (RFC 7946); sigma_m: larger semi-axis of the 1σ ellipse."""
    places = geodetic_from_local(datum, fused.means)[:, ::-1].tolist()
    sigmas = np.sqrt(np.linalg.eigvalsh(diagonal_blocks(fused.covariance))[:, 1]).tolist()
    features = [
        _feature("Point", place, {"landmark": landmark, "sigma_m": sigma})
        for landmark, place, sigma in zip(fused.ids.tolist(), places, sigmas, strict=True)
    ]
    for robot, path in paths.items():
        line = geodetic_from_local(datum, path.poses[:, :2])[:, ::-1].tolist()
        if len(line) > 1:
            features.append(_feature("LineString", line, {"robot": robot}))
    file = folder / "map.geojson"
    whole = {"type": "FeatureCollection", "features": features}
    file.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")
    return file


def _feature(kind: str, at: list[Any], properties: Mapping[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": at}
    return {"type": "Feature", "geometry": geometry, "properties": dict(properties)}


def write_paths(paths: Mapping[str, SmoothedPath], folder: FilePath) -> list[FilePath]:
    """Write <robot>.csv and <robot>.tum; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for robot, path in paths.items():
        table, tum = folder / f"{robot}.csv", folder / f"{robot}.tum"
        with table.open("w", encoding="ascii", newline="") as lines:
            writer = csv.writer(lines, lineterminator="\n")
            writer.writerow(PATH_COLUMNS)
            for stamp, pose, P in zip(
                path.stamps_ns.tolist(), path.poses.tolist(), path.covariances, strict=True
            ):
                upper = P[(0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2)].tolist()
                writer.writerow([seconds(stamp), *pose, *upper])
        write_tum(Path(path.stamps_ns, path.poses), tum)
        written += [table, tum]
    return written


KINDS = ("smoothed", "online")


def write_tum(path: Path, file: FilePath) -> None:
    """Write a planar path in the TUM format of evo: `timestamp tx ty tz qx qy qz qw` [s], [m].

    https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
    """
    half = 0.5 * path.poses[:, 2]
    with file.open("w", encoding="ascii", newline="\n") as lines:
        lines.write("# timestamp tx ty tz qx qy qz qw\n")
        for stamp, (x, y, _), qz, qw in zip(
            path.stamps_ns.tolist(), path.poses, np.sin(half), np.cos(half), strict=True
        ):
            lines.write(f"{seconds(stamp)} {x:.17g} {y:.17g} 0 0 0 {qz:.17g} {qw:.17g}\n")


def seconds(stamp_ns: int) -> str:
    """Stamp in seconds with nanosecond digits."""
    whole, rest = divmod(abs(stamp_ns), 10**9)
    return f"{'-' * (stamp_ns < 0)}{whole}.{rest:09d}"


def write_trajectories(evaluation: Evaluation, folder: FilePath) -> list[FilePath]:
    """Write r1.smoothed.tum, r1.online.tum and r1.truth.tum of every robot; return the files.

    r1.smoothed.truth.tum and r1.online.truth.tum hold the true poses at the path's stamps.
    """
    written = []
    folder.mkdir(parents=True, exist_ok=True)
    for name, robot in evaluation.robots.items():
        paths = {"truth": robot.truth}
        for kind, path in zip(KINDS, (robot.smoothed_path, robot.online_path), strict=True):
            paths[kind] = path
            paths[f"{kind}.truth"] = associate_truth(path, robot.truth)[1]
        for kind, path in paths.items():
            if len(path.stamps_ns):
                written.append(folder / f"{name}.{kind}.tum")
                write_tum(path, written[-1])
    return written


def export_tum(log: Log, folder: FilePath) -> list[FilePath]:
    """Write every robot's paths. Raises LogError without one."""
    written = write_trajectories(evaluate(log.samples()), folder)
    if not written:
        remedy = "`teamslam rerun` computes them, `--format csv` writes what there is"
        raise LogError(log.path, "no robot's path in it", remedy)
    return written
