"""Instruments given by the job, several at once: labels that add up, forces in place of loads."""

import re
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from dome import OPENING_MM, block, patch
from pydantic import ValidationError

import synth
from synth.errors import UserError
from synth.fem import solver, tool_gesture
from synth.fem.material import Tissue
from synth.fem.surface_embedding import vertex_area
from synth.job import mechanics_sections, reader, schema
from synth.render.camera import camera
from synth.sequence import scenario
from synth.sequence.draw import draw_scenario, read_lens, read_scheme

PUSH = {"gesture": "push", "place": [4.0, 0.0], "direction": [0.0, 0.6, -0.8], "load": 0.1}
PUSH |= {"footprint_mm": 3.5, "timing": [0.1, 0.3, 0.6, 0.9]}
PULL = {"gesture": "pull", "place": [-5.0, 1.0], "force_mn": 1.5, "direction": [0, 0, 2]}


def make_job(*crew: dict[str, Any], **fem: Any) -> synth.Job:
    return synth.Job.model_validate({"seed": 3, "sequences": 20, "fem": {"instrument_list": crew, **fem}})


def test_given_values_are_used_and_the_others_drawn() -> None:
    job = make_job(PUSH, PULL)
    cases = [draw_scenario(job, index) for index in range(20)]
    for case in cases:
        push, pull = case.gestures
        assert (push.kind, push.point_mm, push.load, push.footprint_mm) == ("push", (4.0, 0.0), 0.1, 3.5)
        assert push.direction == pytest.approx((0.0, 0.6, -0.8))
        assert push.timing == (0.1, 0.3, 0.6, 0.9)
        assert push.force_mn == pytest.approx(0.1 * case.tissue.young_kpa * 3.5**2)
        assert (pull.kind, pull.point_mm, pull.direction) == ("pull", (-5.0, 1.0), pytest.approx((0, 0, 1)))
        assert pull.force_mn == pytest.approx(1.5)
        assert 3 <= pull.footprint_mm <= 6
        assert tool_gesture.clearance(push, pull) >= 0
    for attribute in ("azimuth_deg", "hover_mm"):
        assert len({getattr(case.gestures[0], attribute) for case in cases}) == 20
    assert len({case.gestures[1].timing for case in cases}) == 20


def test_contradictions_are_refused() -> None:
    timings = ([0.2, "0.6 s", "1 s", "1.6 s"], [0.2, 0.6, 1.2, 1.6])
    contradictions = (
        {"place": [11, 0]},
        {"gesture": "slide", "direction": [0, 0, -1]},
        {"load": 0.1, "force_mn": 1},
    )
    for instrument in (*contradictions, *({"timing": timing} for timing in timings)):
        with pytest.raises(ValidationError, match="instrument_list"):
            make_job(instrument)


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_labels_of_two_instruments_add_up_and_both_touch(law: str) -> None:
    fem = schema.FemSection(law=law, tets=400, load=(0.1, 0.15), instruments=2, gestures=("pull", "push"))
    rng, frames, tissue = np.random.default_rng(3), 17, Tissue(1.0, 0.4, law)
    gestures = scenario.draw_gestures(fem, OPENING_MM, tissue.young_kpa, rng, rng)
    tets, surface = block(fem), patch()
    motion = solver.deform(read_scheme(fem), tissue, gestures, tets, surface, frames, 25.0)
    area = vertex_area(*surface)
    np.testing.assert_allclose(motion.by_instrument.sum(axis=1), motion.force, atol=1e-12)
    vertices = surface.vertices + motion.displacement
    for k, gesture in enumerate(gestures):
        distances, radii = [], []
        for tool in (gesture, gestures[1 - k]):
            distances.append(np.linalg.norm(surface.vertices[:, :2] - tool.contacts[0].point_mm, axis=1))
            radii.append(np.linalg.norm(tool.axes, axis=1).max())
        own_vertices, other_vertices = distances[0] < 1.1 * radii[0], distances[1] < radii[1]
        if not (own_vertices & other_vertices).any():
            part = np.einsum("v,tvd->td", area[own_vertices], motion.traction[:, own_vertices])
            np.testing.assert_allclose(part, motion.by_instrument[:, k], atol=1e-9)
        force = np.linalg.norm(motion.by_instrument[:, k], axis=1)
        distance = np.linalg.norm(motion.tip[:, 2 * k : 2 * k + 2, None] - vertices[:, None], axis=3).min(
            axis=2
        )
        assert distance[force > 0.05 * force.max()].max() < 0.6  # half a vertex spacing
        assert distance[0].min() > 3
    if law == "linear":
        displacements = [
            solver.deform(read_scheme(fem), tissue, [g], tets, surface, frames, 25.0).displacement
            for g in gestures
        ]
        np.testing.assert_allclose(motion.displacement, sum(displacements), atol=1e-8)


def test_a_force_replaces_the_load() -> None:
    fem = schema.FemSection(force_mn=(3.0, 5.0), young_kpa=(2.0, 3.0), footprint_mm=(3.0, 4.0))
    assert fem.largest_load == pytest.approx(5.0 / 18)
    for seed in range(20):
        tissue = scenario.draw_tissue(fem, np.random.default_rng(seed))
        gesture = scenario.draw_gesture(fem, OPENING_MM, tissue.young_kpa, np.random.default_rng(seed))
        force = np.linalg.norm(gesture.contacts[0].force_mn)
        assert 3.0 <= force <= 5.0
        assert force == pytest.approx(gesture.load * tissue.young_kpa * gesture.footprint_mm**2)
    assert schema.FemSection(force_mn=0.2).chosen_law[0] == "linear"


def test_the_page_has_the_table_of_instruments() -> None:
    page = (Path(__file__).parents[3] / "docs/howto/instruments.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \|$", page, re.MULTILINE)
    page_tools = {
        gesture: [*re.findall(r"`(\w+)` \d+%", usual), *re.findall(r"`(\w+)`", others)]
        for gesture, usual, others in rows
    }
    assert page_tools == {
        kind: list(tool_shares) for kind, tool_shares in mechanics_sections.INSTRUMENTS.items()
    }
    shares = [int(share) for _, usual, _ in rows for share in re.findall(r"(\d+)%", usual)]
    known_shares = [
        share
        for tool_shares in mechanics_sections.INSTRUMENTS.values()
        for share in tool_shares.values()
        if share
    ]
    assert shares == [round(100 * share) for share in known_shares]


def test_gestures_and_instruments_are_drawn_together() -> None:
    for kind, tool_shares in mechanics_sections.INSTRUMENTS.items():
        for tool in get_args(mechanics_sections.Instrument):
            instrument = {"gesture": kind, "instrument": tool}
            if tool in tool_shares or tool == "none":
                (gesture,) = draw_scenario(make_job(instrument), 0).gestures
                assert (gesture.kind, gesture.instrument) == (kind, tool)
            else:
                with pytest.raises(ValidationError, match=f"a {kind} takes {' or '.join(tool_shares)}"):
                    make_job(instrument)
    spatula_job = make_job(instrument="spatula")
    assert spatula_job.fem.gestures == ("push", "slide", "retract")
    gestures = [draw_scenario(spatula_job, k).gestures[0] for k in range(20)]
    assert {gesture.kind for gesture in gestures} == {"push", "slide", "retract"}
    assert {gesture.instrument for gesture in gestures} == {"spatula"}
    with pytest.raises(ValidationError, match="a pull takes forceps"):
        make_job(instrument="spatula", gestures=["pull", "push"])


@pytest.mark.parametrize("tool", ["forceps", "spatula", "suction", "probe"])
def test_footprints_hold_their_force_and_have_their_form(tool: str) -> None:
    kind = "pull" if tool == "forceps" else "push"
    gesture = draw_scenario(make_job({"gesture": kind, "instrument": tool, "place": [0, 0]}), 0).gestures[0]
    surface = patch(241)
    area = vertex_area(*surface)
    flat = np.column_stack([surface.vertices[:, :2], 0 * area])
    pressure = tool_gesture.footprint(np.zeros(2), gesture.axes, flat, area, tool == "suction")
    assert pressure @ area == pytest.approx(1.0, abs=1e-12)
    # The same P has the same largest pressure, whatever the form.
    assert pressure.max() == pytest.approx(3 / np.pi / gesture.footprint_mm**2, rel=0.02)
    spread = np.linalg.eigh(np.einsum("v,vi,vj->ij", pressure * area, flat[:, :2], flat[:, :2]))
    ratio = np.sqrt(spread.eigenvalues[1] / spread.eigenvalues[0])
    assert ratio == pytest.approx({"forceps": 2.0, "spatula": 2.0}.get(tool, 1.0), rel=0.02)
    alignment = abs(spread.eigenvectors[:, 1] @ gesture.shaft[:2]) / np.linalg.norm(gesture.shaft[:2])
    assert {"forceps": alignment > 0.99, "spatula": alignment < 0.1}.get(tool, True)
    middle_pressure = pressure[np.linalg.norm(flat, axis=1) < 0.1 * gesture.footprint_mm].max()
    assert middle_pressure < 1e-9 if tool == "suction" else middle_pressure > 0.9 * pressure.max()


def test_instruments_are_apart_and_none_points_at_the_lens() -> None:
    job = synth.Job.model_validate({"sequences": 4, "fem": {"instruments": 3}, "render": {"tilt_deg": 40}})
    for case in (draw_scenario(job, k) for k in range(4)):
        lens = camera.place(case.view, read_lens(job.render)).centre
        bars = [scenario._rings(gesture) for gesture in case.gestures]
        for k, gesture in enumerate(case.gestures):
            sight = lens - np.append(gesture.point_mm, 0)
            assert gesture.shaft @ sight < np.cos(np.radians(25)) * np.linalg.norm(sight)
            for other, wide in bars[:k]:
                gap = np.linalg.norm(bars[k][0][:, None] - other, axis=2) - bars[k][1][:, None] - wide
                assert gap.min() >= 3


def test_times_are_parts_of_the_sequence_and_must_lie_in_it() -> None:
    for timing in (["100 ms", "200ms", "400 ms", "600 ms"], ["0.1 s", "0.2s", "0.4 s", " .6 s"]):
        (gesture,) = draw_scenario(make_job({"timing": timing}), 0).gestures
        assert gesture.timing == pytest.approx(np.array([0.1, 0.2, 0.4, 0.6]) / (23 / 25))
    with pytest.raises(UserError, match=r"1200 ms.*920 ms"):
        reader.parse_job("fem: {instrument_list: [{timing: [1 ms, 2 ms, 3 ms, 1200 ms]}]}", "", Path())


@pytest.mark.parametrize("frames", range(3, 25))
def test_frames_before_the_contact_and_in_it(frames: int) -> None:
    for index in range(24):
        case = draw_scenario(synth.Job(frames=frames, sequences=24), index)
        load = tool_gesture.trajectory(case.gestures[0], frames).load
        assert load[: 1 + (frames > 3)].max() == 0
        assert load.max() > 0.5
