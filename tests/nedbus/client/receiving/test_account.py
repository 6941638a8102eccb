"""The account of a subscription: received + lost + dropped = sent, in order and without duplicates, on any link."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter

import hypothesis.strategies as st
import pytest
from hypothesis import Phase, settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from nedbus import Mode

from .account_model import UNLIMITED, QueueAccount, Setting, World

SLOT, POSITION, COUNT, FLAG = st.integers(0, 2), st.integers(0, 40), st.integers(1, 12), st.integers(0, 1)
MISSING = st.sampled_from([0, 0, -1]) | st.integers(0, 255)


def step(name: str, *arguments: st.SearchStrategy[int], when: str = "world") -> Callable[..., None]:
    """Return a Hypothesis rule for a step of World, enabled if `when` is not empty."""

    def take(machine: AccountMachine, arguments: tuple[int, ...]) -> None:
        machine.world.step(name, *arguments)

    take.__name__ = name
    return precondition(attrgetter(when))(rule(arguments=st.tuples(*arguments))(take))


class AccountMachine(RuleBasedStateMachine):
    """Take random steps, then settle."""

    @initialize(
        mode=st.sampled_from(["every", "every", "latest"]),
        keeps=st.lists(st.sampled_from([UNLIMITED, 3, 0]), min_size=1, max_size=3),
        capacity=st.sampled_from([UNLIMITED, UNLIMITED, 16]),
    )
    def begin(self, mode: Mode, keeps: list[int], capacity: int) -> None:
        setting = Setting(mode, tuple(keeps), capacity)
        self.world = World(setting, QueueAccount(setting))

    publish = step("publish", SLOT, COUNT, FLAG)
    restart = step("restart", SLOT)
    deliver = step("deliver", COUNT | st.just(UNLIMITED), when="world.flight")
    overflow = step("deliver", COUNT, COUNT, when="world.flight")
    drop = step("drop", POSITION, st.integers(1, 4), when="world.flight")
    delay = step("delay", POSITION, st.integers(1, 4), FLAG, when="world.flight")
    link = step("link", FLAG)
    heartbeat = step("heartbeat", SLOT)
    answer = step("answer", POSITION, MISSING, FLAG, when="world.open")
    read = step("read", COUNT, FLAG)
    settle = step("settle")

    def teardown(self) -> None:
        if hasattr(self, "world") and self.world.intact:
            self.world.step("settle")


TestAccount = AccountMachine.TestCase
TestAccount.settings = settings(stateful_step_count=40, phases=set(Phase) - {Phase.explain})  # which takes minutes

SEEDS = [
    # It is read twice.
    (Setting("latest"), "publish 0 1, delay 0 1 1, deliver 2"),
    # 0 takes the place of 1, which is the newest.
    (Setting("latest"), "publish 0 2, delay 0 1, deliver 2"),
    # 1 is counted as lost before it comes.
    (Setting("latest"), "publish 0 3, deliver 1, delay 0 1, deliver 2"),
    # 1 and 2 are requested, only 2 arrives: 1 is not requested again, and lost.
    (Setting(), "publish 0 4, deliver 1, drop 0 2, deliver 1, answer 0 1 0"),
    # 6 is expected of the first life: that of the second is taken for it, is read before 0 to 5, and again.
    (Setting(), "publish 0 6, deliver 6, link 1, restart 0, publish 0 8, drop 0 6, deliver 2"),
    # 1 is requested, 2 announced by a heartbeat, and the publisher has gone: 1 is lost, and 2 is not counted.
    (Setting(), "publish 0 2, deliver 1, heartbeat 0, publish 0 1, heartbeat 0, link 1, restart 0"),
    # The cache has 2 to 4, then 3 to 5: 1 is lost, and 5 is still requested.
    (Setting(keeps=(3,)), "publish 0 5, deliver 1, heartbeat 0, answer 0, publish 0 1, link 1"),
    # 1 and 3 are missing, and 3 to 5 are kept: 2, which is here, is not passed over.
    (Setting(keeps=(3,)), "publish 0 6, deliver 1, drop 0 1, drop 1 1"),
]


@pytest.mark.parametrize(("setting", "steps"), SEEDS)
def test_steps_that_found_a_fault(setting: Setting, steps: str) -> None:
    """The account is right after step sequences that once found a bug in an earlier receive path."""
    world = World(setting, QueueAccount(setting))
    for name, *arguments in map(str.split, f"{steps}, settle".split(", ")):
        world.step(name, *map(int, arguments))
