from __future__ import annotations

import pytest

from gdp.crypto.statements import StatementType, parse, sign
from gdp.errors import DropReason, StatementError
from gdp.trust.advertisement import Withdrawal
from gdp.trust.right import Right
from tests.gdp.trust.world import CAMERA, NOW, ROBOT

BODY = {"n": CAMERA.name, "right": "publish", "s": 1}


def test_a_withdrawal_is_read_as_it_was_written() -> None:
    withdrawal = Withdrawal(CAMERA.name, Right.PUBLISH, 7)
    assert Withdrawal.received(parse(withdrawal.to_wire(ROBOT.name, ROBOT.key)), NOW) == withdrawal


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"right": "rule"}, DropReason.MALFORMED),
        ({"s": int(NOW + 1e9) * 1_000}, DropReason.MALFORMED),
        ({"more": bytes(1 << 10)}, DropReason.TOO_BIG),
    ],
)
def test_a_withdrawal_out_of_its_bounds_is_refused(change: dict[str, object], reason: DropReason) -> None:
    wire = sign(StatementType.WITHDRAW, {**BODY, **change}, ROBOT.name, ROBOT.key)
    with pytest.raises(StatementError) as refused:
        Withdrawal.received(parse(wire), NOW)
    assert refused.value.reason is reason
