from __future__ import annotations

from fog.supervisor.activity import Activity, requests_in

LOG = """{"event":"ready"}
{"event":"progress","sent":1,"received":4}
{"event":"progress","sent":2,"received":7}
word
"""


def test_the_last_word_of_a_proxy_counts() -> None:
    assert requests_in(LOG) == 7
    assert requests_in(LOG + '{"event":"progress","rec') == 7
    assert requests_in("nothing\n") is None


def test_a_cluster_is_idle_since_its_last_request() -> None:
    activity = Activity(100.0)
    assert activity.idle_s({"m1": 0}, 110.0) == 10.0
    assert activity.idle_s({"m1": 3}, 120.0) == 0.0
    assert activity.idle_s({"m1": 3, "m2": 0}, 150.0) == 30.0


def test_a_machine_that_cannot_be_asked_counts_as_used() -> None:
    assert Activity(0.0).idle_s({"m1": None}, 500.0) == 0.0
