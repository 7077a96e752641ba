"""Basis of the experiments' figures: statistics, frames with known truth, planners that can be stopped."""

from __future__ import annotations

import importlib.util
import json
import os
import random
import subprocess
import sys

import pytest

from tests.pages import ROOT
from tests.script_packages import PYTHON_PATH

PLANNING = """
import json, pathlib, sys
from planning import Problem, be_quiet
be_quiet()
slit = Problem.load(pathlib.Path(sys.argv[1]), "Slit")
way = slit.solve("RRTConnect", 100.0, lambda: False).way
asked = iter([False, True])
stopped = slit.solve("RRTConnect", 100.0, lambda: next(asked, True)).way
ends = {"start": list(slit.start), "goal": list(slit.goal)}
print(json.dumps({"way": [list(each) for each in way], **ends, "stopped": stopped}))
"""
MESHES = ROOT / "scripts" / "data" / "planning"


def needs(*modules: str) -> None:
    for module in modules:
        pytest.importorskip(module, reason=f"{module} is not installed: pip install 'gdp-ros[experiments]'")


def test_the_least_of_two_takes_every_pair_once() -> None:
    from samples import least_of_two

    assert sorted(least_of_two([3.0, 1.0, 2.0])) == [1.0, 1.0, 2.0]


def test_the_p99_of_few_values_is_the_largest() -> None:
    from samples import p99

    assert p99([5.0, 9.0, 1.0]) == 9.0
    assert p99([float(value) for value in range(1, 201)]) == 198.0


def test_a_failed_request_counts_with_the_time_that_it_cost() -> None:
    from samples import Sample, Summary

    right = Sample("/s", 0.0, 1.0, "m1", 0.5, is_right=True)
    failed = Sample("/s", 1.0, 9.0, "", 0.0, is_right=False)
    summary = Summary.of([right, failed])
    assert (summary.count, summary.failed, summary.mean_s, summary.worst_s) == (2, 1, 5.0, 9.0)


def test_what_is_drawn_is_found_and_counted() -> None:
    needs("scipy")
    from vision import Scene, count_regions, find_objects

    for seed in range(3):
        scene = Scene.draw(seed)
        assert scene.agrees(find_objects(scene.frame))
        assert count_regions(scene.frame) == count_regions(scene.frame, 4) == len(scene.centres)


def test_an_object_too_many_or_elsewhere_is_wrong() -> None:
    needs("scipy")
    from vision import Scene

    scene = Scene.draw(1)
    found = list(scene.centres)
    assert scene.agrees(found)
    assert not scene.agrees([*found, (5, 5)])
    assert not scene.agrees([(row + 10, column) for row, column in found])


def test_a_frame_comes_through_its_carrier_unchanged() -> None:
    needs("scipy", "rcl_interfaces")
    from image_request import answer_of, frame_of, number_of, request_of, said_in
    from vision import Scene

    frame = Scene.draw(2).frame
    request = request_of(frame, 7)
    assert (frame_of(request) == frame).all()
    assert number_of(request) == 7
    assert said_in(answer_of({"machine": "m1"})) == {"machine": "m1"}


def test_a_drawn_tag_is_found_where_it_is() -> None:
    needs("pupil_apriltags", "scipy")
    from tag import Pose, TagCamera

    camera = TagCamera()
    for number in (0, 40, 90):
        truth = Pose.on_its_way(number)
        found = camera.find(camera.draw(truth))
        assert found is not None
        assert found.apart_m(truth) < 0.005
        assert found.turned_rad(truth) < 0.03


def test_a_planner_finds_a_path_and_stops_on_command() -> None:
    for module in ("ompl", "fcl", "trimesh", "collada"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed: pip install 'gdp-ros[experiments]'")
    # In a child process: in one process with the libraries of ROS, OMPL's library has been seen to abort on loading.
    environment = {**os.environ, "PYTHONPATH": f"{PYTHON_PATH}:{ROOT / 'scripts/experiments'}:{ROOT / 'scripts/bench'}"}
    done = subprocess.run(
        [sys.executable, "-c", PLANNING, str(MESHES)],
        env=environment, capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["way"][0][:3] == pytest.approx(said["start"])
    assert said["way"][-1][:3] == pytest.approx(said["goal"])
    assert said["stopped"] is None


def test_the_camera_moves_as_recorded() -> None:
    needs("cv2", "rclpy")
    from offload_tasks import Vslam

    task = Vslam()
    answers = [task.compute(task.request(number)) for number in (1, 2)]
    assert task.is_right(1, answers[0])
    assert task.is_right(2, answers[1])
    assert not task.is_right(3, answers[0])


def test_a_grasp_is_on_the_object_that_the_mask_shows() -> None:
    needs("cv2", "scipy", "rclpy")
    from offload_tasks import GraspPlanning

    task = GraspPlanning()
    answer = task.compute(task.request(1))
    assert task.is_right(1, answer)
    answer.pose.position.x, answer.pose.position.y = 0.0, 0.0
    assert not task.is_right(1, answer)


def test_there_is_no_grasp_of_nothing() -> None:
    needs("scipy")
    import numpy as np
    from grasp.sampler import plan_grasp

    shape = (40, 50)
    assert plan_grasp(np.ones(shape, np.float32), np.zeros(shape, np.uint8), 500.0, seed=1) is None


def test_waits_are_recorded_runs_shortened_and_drawn_for_each_replica_alone() -> None:
    from recorded import RECORDED, draw, load

    for name, runs in load().items():
        waits = draw(runs, RECORDED[name].faster, 20, random.Random(1))
        others = draw(runs, RECORDED[name].faster, 20, random.Random(2))
        assert {round(wait * RECORDED[name].faster, 9) for wait in waits} <= {round(each, 9) for each in runs}
        assert waits != others


def test_a_request_is_lost_only_while_all_its_machines_stay_down() -> None:
    needs("matplotlib")
    from outages import Outage, share_unanswered

    one, other = [Outage(1.0, 4.0)], [Outage(3.0, 8.0)]
    assert share_unanswered([one], 10.0, 0.0) == pytest.approx(0.3, abs=0.01)
    assert share_unanswered([one], 10.0, 0.5) == pytest.approx(0.25, abs=0.01)
    assert share_unanswered([one, other], 10.0, 0.5) == pytest.approx(0.05, abs=0.01)


def test_outages_last_and_come_as_often_as_they_are_drawn_to() -> None:
    needs("matplotlib")
    from outages import DOWN_S, UP_S, draw_outages

    seconds = 20_000.0
    outages = draw_outages(random.Random(1), seconds)
    down = sum(each.to_s - each.from_s for each in outages) / seconds
    assert down == pytest.approx(DOWN_S / (UP_S + DOWN_S), rel=0.1)


def test_the_table_of_both_papers_is_of_the_shipped_figures() -> None:
    from results import machines_of, page_of, rows_of

    pages = ROOT / "docs" / "experiments"
    rows, missing = rows_of(pages, ())
    assert (pages / "papers.md").read_text(encoding="utf-8") == page_of(rows, machines_of(pages), missing)
    assert {row.figure for row in rows} == {
        "G Table I", "G Figure 5", "FT Table I", "FT Figure 4", "FT Figure 5", "FT Figure 6", "FT Figure 7",
        "FT Figure 9", "FT availability",
    }  # fmt: skip


def test_the_page_of_table_one_and_figure_five_is_of_the_shipped_figures() -> None:
    from offload_page import PAPER, page_of

    pages = ROOT / "docs" / "experiments"
    document = json.loads((pages / "offload.json").read_text(encoding="utf-8"))
    assert set(document["tasks"]) == set(PAPER)
    assert (pages / "offload.md").read_text(encoding="utf-8") == page_of(document)
