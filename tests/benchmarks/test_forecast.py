"""The comparison of forecast and measurement: its formula by hand, and run once on tiny data."""

import pytest

from benchmarks.forecast import Point, expected_rate, forecast_section, measure_forecast
from benchmarks.server import Network
from stereogenbench_data.datasets.scaling import SampleCost

FOUND = {
    "local": SampleCost(0.01, 1e6, 2, slowdown=1.5),
    "far": SampleCost(0.012, 1e6, 2, slowdown=1.5),
    "cores": 2,
}


@pytest.mark.parametrize(
    ("workers", "network", "expected"),
    [
        (1, None, (100, "processor")),
        (2, None, (2 / 0.015, "processor")),
        (1, Network(0.06), (1 / 0.015, "delay x connections")),
        (2, Network(0.0, connection_mb_s=1), (16, "connection bandwidth")),
        (2, Network(0.0, total_mb_s=5), (5, "total bandwidth")),
    ],
)
def test_a_point_is_forecast_by_its_network(workers, network, expected):
    rate, limit = expected_rate(FOUND, Point("all-frames", "released", workers, network))

    assert (pytest.approx(rate), limit) == expected


def test_points_are_measured_and_compared(material):
    points = (
        Point("all-frames", "released", 1, None),
        Point("all-frames", "training", 1, Network(0.01, connection_mb_s=5)),
    )
    rows = measure_forecast(
        material, scenes=2, points=points, seconds=0.5, rounds=1, report=lambda text: None
    )
    text = forecast_section(rows)

    assert [row["kind"] for row in rows] == ["released", "training"]
    assert all(row["forecast"] > 0 and row["measured"] > 0 for row in rows)
    assert "10 ms, 5 MB/s each" in text
    assert "local disk" in text
