"""Flow at large motion, and where it fails: clinical loads at 640 × 480, tracked from rest to 160 px.

A video is tracked with all of its frames and with every second, fourth and eighth, so that the same motion is
reached by smaller and by larger steps. By estimator, motion of the tissue that moves most, and step.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from evidence import report
from evidence.flow.measure import epe
from evidence.study import Study
from synth.flow.confidence import LOW_CONFIDENCE
from synth.job import reader
from synth.sequence.rest_scene import Scene
from synth.sequence.simulation import simulate

Row = dict[str, Any]
ESTIMATORS = "tvl1", "opencv-tvl1", "dis"
_GESTURES = "retract", "grasp", "push"
_EVERY = 1, 2, 4, 8  # frames
_MOTION_PX = 5, 10, 20, 40, 80, 160
_STEP_PX = 1, 3, 10, 30
_WRONG_PX = 3.0
_MOST = 0.99  # quantile of the motion over visible tissue that is called its motion


def measure(
    frames: int = 50, travel_mm: float = 13.0, field_mm: float = 24.0, seed: int = 71
) -> dict[str, Any]:
    """Errors of the estimators on a retraction, a grasp and a press up to their largest motion.

    `frames`: of a video of two seconds; `travel_mm`: of the instrument; `field_mm`: width of the
    picture, half of the usual, so that motions are twice as large.
    """
    rows = []
    for gesture in _GESTURES:
        changes = [
            f"fem.gestures=[{gesture}]",
            f"fem.travel_mm={travel_mm}",
            "fem.membrane.probability=0",
            f"render.field_mm={field_mm}",
            f"frames={frames}",
            f"fps={frames / 2}",
            f"seed={seed}",
            "sequences=1",
        ]
        rows += list(_track(simulate(reader.load_job("clinical", changes)), gesture))
    return {"rows": rows, "frames": frames, "travel_mm": travel_mm, "field_mm": field_mm}


def _track(scene: Scene, gesture: str) -> Iterator[Row]:
    """A row of each estimator, pace and frame."""
    shots = [scene.frame(t) for t in range(scene.strongest + 1)]
    for stride in _EVERY:
        subset = shots[::stride] if shots[::stride][-1] is shots[-1] else [*shots[::stride], shots[-1]]
        for name in ESTIMATORS:
            track = scene.recover_flow(subset, name)
            previous_motion = 0.0
            for k, shot in enumerate(subset[1:], 1):
                visible = scene.tissue & shot.visible
                lengths = np.linalg.norm(shot.flow, axis=-1)[visible]
                error = epe(track.flow[k], shot.flow)[visible]
                confident = (track.confidence[k] >= LOW_CONFIDENCE)[visible]
                motion = float(np.quantile(lengths, _MOST))
                yield {
                    "gesture": gesture,
                    "estimator": name,
                    "motion": motion,
                    "step": abs(motion - previous_motion),
                    "error": float(np.median(error)),
                    "error at the contact": float(np.mean(error[lengths > 0.5 * motion])),
                    "no flow": float(np.mean(lengths[lengths > 0.5 * motion])),
                    "lost": float(1 - confident.mean()),
                    "wrong and sure": float((confident & (error > _WRONG_PX)).mean()),
                }
                previous_motion = motion


def page(data: Mapping[str, Any]) -> report.Page:
    """Error against motion for each size of step, and all means."""
    rows = [
        row
        | {"motion [px]": _nearest(row["motion"], _MOTION_PX), "step [px]": _nearest(row["step"], _STEP_PX)}
        for row in data["rows"]
        if row["motion"] > _MOTION_PX[0] / np.sqrt(2)
    ]
    keys = "error", "error at the contact", "no flow", "lost", "wrong and sure"
    groups = report.group_rows(rows, "estimator", "step [px]", "motion [px]")
    table = [
        {"estimator": name, "step [px]": step, "motion [px]": motion, "frames": len(part)}
        | {key: float(np.mean([row[key] for row in part])) for key in keys}
        for (name, step, motion), part in sorted(groups.items())
    ]
    default_rows = [row for row in rows if row["estimator"] == ESTIMATORS[0]]
    small_steps = [row for row in default_rows if row["step [px]"] <= _STEP_PX[1]]
    middle = np.median([row["error"] for row in small_steps])
    wrong, wrong_all = (
        np.mean([row["wrong and sure"] for row in part]) for part in (small_steps, default_rows)
    )
    words = (
        f"**In steps of up to {_STEP_PX[1]} px `{ESTIMATORS[0]}` errs {middle:.2f} px (median of the "
        f"frames' medians over visible tissue); {wrong:.1%} of it is sure and off by over {_WRONG_PX:g} "
        f"px, in all steps {wrong_all:.1%}.**",
        f"A retraction, a grasp and a press of {data['travel_mm']:g} mm by the job `clinical`, 640 px of "
        f"{data['field_mm']:g} mm, {data['frames']} frames in two seconds, up to their largest motion; "
        "with every frame and every second, fourth and eighth. Errors in px: *error*, median over visible "
        "tissue; *at the contact*, "
        "mean where tissue moves more than half as far as the farthest; *no flow*, the error there of "
        "assuming that nothing moves. *Lost*: share of visible tissue of low confidence. *Wrong and sure*: "
        f"share off by over {_WRONG_PX:g} px with confidence of at least {LOW_CONFIDENCE:g}.",
    )
    chart = report.chart(
        lambda axes: _draw(axes, table, "error at the contact", "error at the contact [px]"),
        lambda axes: _draw(axes, table, "lost", "share lost"),
    )
    return report.Page("Flow at large motion", data, words, [report.Section("", table)], chart)


def _nearest(value: float, candidates: tuple[int, ...]) -> int:
    return min(candidates, key=lambda size: abs(np.log(max(value, 1e-3) / size)))


def _draw(axes: Axes, table: list[Row], key: str, label: str) -> None:
    """A line of each estimator, drawn through for the smallest steps and dashed for the largest."""
    for color, name in enumerate(ESTIMATORS):
        for step, style in ((_STEP_PX[1], "-"), (_STEP_PX[-1], "--")):
            part = [row for row in table if row["estimator"] == name and row["step [px]"] == step]
            if part:
                x, y = [row["motion [px]"] for row in part], [row[key] for row in part]
                axes.plot(x, y, style, color=f"C{color}", marker="o", label=f"{name}, steps of {step} px")
    axes.set(xlabel="motion [px]", ylabel=label)
    report.set_log(axes, "x" if key == "lost" else "xy")
    report.legend(axes)


STUDY = Study(
    measure,
    "flow/large_motion/large_motion.json",
    page,
    needs=("mesh", "mechanics", "picture", "truth", "flow"),
)
