"""Measurements of a receiver."""

from __future__ import annotations

from proxy.bridge.core.topic_stats import TopicStats, percentile


def test_topic_stats_report_the_usual_path_and_all_paths_that_were_seen() -> None:
    stats = TopicStats(topic="/t", type_name="std_msgs/msg/String")
    for hops in (5, 5, 2, 5):
        stats.add(1.0, 3, hops)
    fields = stats.to_fields()
    assert (fields["hops"], fields["hops_seen"], fields["received"], fields["parts"]) == (5, [2, 5], 4, 3)


def test_without_a_message_there_is_no_latency_and_no_way() -> None:
    fields = TopicStats(topic="/t", type_name="std_msgs/msg/String").to_fields()
    assert fields["latency_ms"] == {"median": None, "p99": None, "max": None}
    assert (fields["hops"], fields["hops_seen"]) == (0, [])


def test_percentiles_are_values_that_were_measured() -> None:
    ordered = [float(value) for value in range(1, 101)]
    assert (percentile(ordered, 0.5), percentile(ordered, 0.99), percentile(ordered, 1)) == (51.0, 100.0, 100.0)
    assert percentile([7.0], 0.99) == 7.0


def test_a_message_that_comes_again_is_counted_and_a_restarted_publisher_is_not() -> None:
    stats = TopicStats(topic="/t", type_name="std_msgs/msg/String")
    for incarnation, number in ((1, 1), (1, 2), (1, 2), (1, 1), (2, 1), (1, 3)):
        stats.count_number(b"p" * 32, incarnation, number)
    assert stats.to_fields()["duplicated"] == 2


def test_messages_of_one_bundle_share_a_number_and_are_not_counted_as_come_again() -> None:
    stats = TopicStats(topic="/t", type_name="std_msgs/msg/String")
    for number, place in ((1, 0), (1, 1), (1, 2), (2, 0), (1, 2), (2, 0), (2, 1)):
        stats.count_number(b"p" * 32, 1, number, place)
    assert stats.to_fields()["duplicated"] == 2
