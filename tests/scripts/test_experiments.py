"""Basis of the experiments' figures: statistics, frames with known truth, planners that can be stopped."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

from lab.process import python_path
from tests.draws import IS_LONG
from tests.pages import ROOT

PLANNING = """
import json, pathlib, sys
from ompl import util
from planning import Problem, be_quiet
util.RNG.setSeed(1)  # else the first sample may lie in the slit, and a search that is stopped at once has a path
be_quiet()
slit = Problem.load(pathlib.Path(sys.argv[1]), "Slit")
way = slit.solve("RRTConnect", 100.0, lambda: False)
asked = iter([False, True])
stopped = slit.solve("RRTConnect", 100.0, lambda: next(asked, True))
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


def test_the_network_covers_the_drawn_words() -> None:
    needs("scipy", "rapidocr_onnxruntime")
    from vision import Network, Scene

    network = Network()
    for seed in range(3 if IS_LONG else 1):
        scene = Scene.draw(seed)
        assert scene.is_covered(network.segment(scene.frame))


def test_the_network_finds_nothing_where_nothing_is_drawn() -> None:
    needs("scipy", "rapidocr_onnxruntime")
    import numpy as np
    from vision import SHAPE, Network

    assert not Network().segment(np.full(SHAPE, 70, np.uint8)).any()


def test_words_are_counted_without_a_network() -> None:
    needs("scipy")
    from vision import Scene, count_words

    for seed in range(24):
        scene = Scene.draw(seed)
        assert count_words(scene.frame) == len(scene.words)


def test_a_mask_with_a_region_too_many_or_too_few_or_a_part_of_each_is_wrong() -> None:
    needs("scipy")
    import numpy as np
    from vision import SHAPE, Scene

    scene = Scene.draw(1)
    drawn = np.zeros(SHAPE, np.bool_)
    part = drawn.copy()
    for _, (top, left, bottom, right) in scene.words:
        drawn[top:bottom, left:right] = True
        part[top:bottom, left : (2 * left + right) // 3] = True
    assert scene.is_covered(drawn)
    assert not scene.is_covered(part)
    more, less = drawn.copy(), drawn.copy()
    more[0, 0] = True
    top, left, bottom, right = scene.words[0][1]
    less[top:bottom, left:right] = False
    assert not scene.is_covered(more)
    assert not scene.is_covered(less)


def test_an_answer_is_judged_by_what_the_task_asked_for() -> None:
    needs("scipy", "rcl_interfaces")
    import numpy as np
    from frames import answer_of, text_of
    from tasks import task_of
    from vision import SHAPE, Scene

    words = Scene.draw(3).words
    mask = np.zeros(SHAPE, np.bool_)
    for _, (top, left, bottom, right) in words:
        mask[top:bottom, left:right] = True
    answers: dict[str, tuple[dict[str, object], dict[str, object]]] = {
        "segment": ({"mask": text_of(mask)}, {"mask": text_of(~mask)}),
        "count": ({"words": len(words)}, {"words": 0}),
    }
    for name, both in answers.items():
        task = task_of(name)
        judged = [task.judge(3, answer_of({"machine": "m1", "worked_s": 0.1, **said})) for said in both]
        assert [each.is_right for each in judged] == [True, False], name


def test_a_figure_that_computes_refuses_without_the_network(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    needs("scipy", "rcl_interfaces", "matplotlib")
    import fig6
    import vision
    from experiment import command_line, run_experiment

    monkeypatch.setattr(vision, "find_spec", lambda _: None)
    parser = command_line("")
    parser.add_argument("--compute", action="store_true")
    parser.set_defaults(computed=2)
    with pytest.raises(SystemExit) as ended:
        run_experiment(parser, fig6.measure, ["--quick", "--compute"])
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "rapidocr_onnxruntime is not installed: pip install" in line


def test_the_waits_of_figure_six_are_recorded_runs_of_the_network() -> None:
    needs("scipy", "rcl_interfaces", "matplotlib")
    from fig6 import REQUESTS, _times
    from recorded import segmentation_runs

    one, other = _times().values()
    assert len(segmentation_runs()) >= REQUESTS
    assert {*one, *other} <= {*segmentation_runs()}
    assert one != other


def test_a_frame_comes_through_its_carrier_unchanged() -> None:
    needs("scipy", "rcl_interfaces")
    from frames import answer_of, frame_of, mask_in, request_of, said_in, text_of
    from vision import Scene

    frame = Scene.draw(2).frame
    request = request_of(frame, 7)
    assert (frame_of(request) == frame).all()
    assert request.parameters[0].name == "7"
    assert said_in(answer_of({"machine": "m1"})) == {"machine": "m1"}
    assert (mask_in(text_of(frame > 100)) == (frame > 100)).all()


def test_a_drawn_tag_is_found_where_it_is() -> None:
    needs("cv2", "scipy")
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
    environment = {**os.environ, "PYTHONPATH": python_path(ROOT / "scripts/experiments", ROOT / "scripts/bench")}
    done = subprocess.run(
        [sys.executable, "-c", PLANNING, str(MESHES)],
        env=environment, capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["way"][0][:3] == pytest.approx(said["start"])
    assert said["way"][-1][:3] == pytest.approx(said["goal"])
    assert said["stopped"] == []


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
    from recorded import FASTER, draw, load

    recorded = load()
    assert recorded.keys() == FASTER.keys()
    for name, each in recorded.items():
        waits = draw(each.runs_s, FASTER[name], 20, random.Random(1))
        others = draw(each.runs_s, FASTER[name], 20, random.Random(2))
        assert {round(wait * FASTER[name], 9) for wait in waits} <= {round(run_s, 9) for run_s in each.runs_s}
        assert waits != others


def test_a_run_that_reaches_the_limit_of_checks_counts_as_the_timeout_of_the_paper(tmp_path: Path) -> None:
    from recorded import LIMIT_S, MOST_CHECKS, load

    recording = tmp_path / "runs.json"
    recording.write_text(json.dumps({"Home": {"planner": "RRT", "checks": [MOST_CHECKS // 4, MOST_CHECKS]}}))
    home = load(recording)["Home"]
    assert (home.planner, home.runs_s) == ("RRT", [LIMIT_S / 4, LIMIT_S])


def test_the_least_of_two_recorded_runs_gains_by_how_rare_the_long_ones_are() -> None:
    from recorded import Recorded

    mean_gain, p99_gain = Recorded("RRT", [1.0] * 97 + [5.0] * 3).gains()
    assert mean_gain == pytest.approx(1.12 / (4_962 / 4_950))
    assert p99_gain == 5.0


def test_a_request_is_lost_only_while_all_its_machines_stay_down() -> None:
    needs("matplotlib")
    from outages import share_unanswered
    from plot import Span

    one, other = [Span("m1", 1.0, 4.0)], [Span("m2", 3.0, 8.0)]
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


def test_a_text_has_one_line_for_each_paragraph_and_each_item_of_a_list() -> None:
    from experiment import text_of

    figures = {"up_s": 9.0, "down_s": 3.0, "patience_s": 0.5}
    lines = text_of("outages", latencies="rows", findings="more", **figures).splitlines()
    assert [line[:12] for line in lines if line] == [
        "# Availabili", "A robot asks", "*By the list", "```bash", "sudo .venv/b", "```", "![Availabili", "rows",
        "more", "- The paper'", "- The machin",
    ]  # fmt: skip
    assert "means of 9 s and 3 s, drawn before" in lines[2]


def test_the_page_of_table_one_and_figure_five_is_of_the_shipped_figures() -> None:
    from experiment import Report
    from machine import MachineState
    from offload_page import PAPER, figures_of

    pages = ROOT / "docs" / "experiments"
    document = json.loads((pages / "offload.json").read_text(encoding="utf-8"))
    shipped = Report("offload", document, {}, lambda *_: None, figures_of(document))
    assert set(document["tasks"]) == set(PAPER)
    assert (pages / "offload.md").read_text(encoding="utf-8") == shipped.to_page(MachineState(**document["machine"]))
