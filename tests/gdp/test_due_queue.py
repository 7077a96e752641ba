"""Queue of due keys: it does what a plain dictionary does."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gdp.due_queue import DueQueue

KEYS = st.integers(0, 7)
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("put"), KEYS, st.integers(0, 50) | st.just(float("inf"))),
        st.tuples(st.just("discard"), KEYS, st.just(0)),
        st.tuples(st.just("poll"), st.integers(1, 4) | st.none(), st.integers(0, 60)),
        st.tuples(st.just("clear"), st.just(0), st.just(0)),
    ),
    max_size=300,
)


@given(STEPS)
def test_it_does_what_a_dictionary_does(steps: list[tuple[str, int | None, float]]) -> None:
    queue, plain = DueQueue[int](), dict[int, float]()
    for word, key, at_s in steps:
        if word == "put" and key is not None:
            queue.put(key, at_s)
            plain[key] = at_s
            if at_s == float("inf"):
                del plain[key]
        elif word == "discard" and key is not None:
            queue.discard(key)
            plain.pop(key, None)
        elif word == "clear":
            queue.clear()
            plain.clear()
        else:
            found = queue.poll_due(at_s, key)
            due = sorted(due_s for due_s in plain.values() if due_s <= at_s)[:key]
            assert [plain.pop(each) for each in found] == due
        assert all((each in queue) == (each in plain) for each in range(8))
        assert len(queue) == len(plain)
        assert queue.next_due() == min(plain.values(), default=None)
        assert all(queue.due_s(each) == plain.get(each, float("inf")) for each in range(8))


def test_what_is_due_at_once_comes_as_it_was_put() -> None:
    queue = DueQueue[str]()
    for key in "cab":
        queue.put(key, 1.0)
    assert queue.poll_due(1.0) == ["c", "a", "b"]


def test_keys_that_come_and_go_leave_nothing() -> None:
    queue = DueQueue[int]()
    for number in range(10_000):
        queue.put(number, 3600.0)
        queue.discard(number)
    assert len(queue._heap) < 200
