"""Machine requests of a cluster: replicas, regions, hardware and refusals."""

import pytest

from fog.cluster import MachineRequest
from fog.hardware import Hardware
from fog.launch.machines import CloudMachine, SpotMachine, filled
from gdp.errors import LocalError


def test_the_listed_machines_are_the_replicas() -> None:
    machines, notes = filled([CloudMachine("us-west-1", "cpu:16"), SpotMachine("us-east-1", "T4")], None)
    assert machines == (
        MachineRequest(Hardware(cpus=16), "us-west-1", is_spot=False),
        MachineRequest(Hardware(gpu="T4", gpus=1), "us-east-1", is_spot=True),
    )
    assert notes == ()


def test_one_machine_becomes_two_in_different_regions_and_this_is_reported() -> None:
    machines, notes = filled([SpotMachine("us-west-1", "cpu:4")], None)
    assert [each.region for each in machines] == ["us-west-1", ""]
    assert [each.is_spot for each in machines] == [True, True]
    assert "other regions" in notes[0]


def test_one_machine_alone_must_be_asked_for() -> None:
    machines, notes = filled([CloudMachine()], 1)
    assert (len(machines), notes) == (1, ())


def test_replicas_in_one_region_are_remarked_on() -> None:
    _, notes = filled([CloudMachine("eu"), CloudMachine("eu")], None)
    assert notes == ("2 replicas are in eu: they may fail together",)


@pytest.mark.parametrize(
    ("deployments", "replicas", "says"),
    [
        ([], None, "deployments is empty"),
        ([CloudMachine()], 0, "at least 1"),
        ([CloudMachine(), CloudMachine()], 1, "2 deployments"),
        (["T4"], None, "expected CloudMachine or SpotMachine, not str"),
    ],
)
def test_what_cannot_be_is_refused(deployments: list[CloudMachine], replicas: int | None, says: str) -> None:
    with pytest.raises(LocalError, match=says):
        filled(deployments, replicas)


def test_unknown_hardware_is_refused_where_it_is_said() -> None:
    with pytest.raises(LocalError, match="cpuu:16"):
        CloudMachine(hardware="cpuu:16")
