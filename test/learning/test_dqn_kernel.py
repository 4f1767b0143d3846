"""The compiled DQN update against a plain torch one, and against what is known by hand."""

from typing import Any, Literal

import numpy as np
import pytest
import torch

from tractor_ems.learning.dqn_kernel import (
    TILE,
    Batch,
    QNet,
    Rule,
    as_arrays,
    best_actions,
    forward,
    make_adam,
    make_workspace,
    move_target,
    net_of,
    parameters,
    random_net,
    td_update,
    value_of,
    zero_net,
)
from tractor_ems.policies import mlp

MODES = pytest.mark.parametrize("double", [True, False], ids=["double", "single"])
Ranges = Literal["all", "one", "narrow", "straddle", "mixed"]


def rule_of(**changed: Any) -> Rule:
    return Rule(**{"double": True, "huber": True, "tanh": False, "margin": 0.0, **changed})


def copy_of(net: QNet) -> QNet:
    return net_of(tuple(net.sizes), net.flat.copy())


def table_net(q: list[list[float]]) -> QNet:
    """A net without hidden layer whose output for one-hot state s is q[s]."""
    values = np.array(q, np.float32)
    flat = np.concatenate([values.ravel(), np.zeros(values.shape[1], np.float32)])
    return net_of(values.shape, flat)


def rows_of(rows: list[tuple[int, int, float, float, int, int, int]], states: int) -> Batch:
    """(state, action, reward, discount, next state, next first, next last), one-hot inputs."""
    state, action, reward, discount, following, first, last = zip(*rows, strict=True)
    eye = np.eye(states, dtype=np.float32)
    count = len(rows)
    return Batch(
        inputs=eye[list(state)],
        action=np.array(action, np.int64),
        reward=np.array(reward, np.float32),
        discount=np.array(discount, np.float32),
        next_inputs=eye[list(following)],
        first=np.zeros(count, np.int16),
        last=np.zeros(count, np.int16),
        next_first=np.array(first, np.int16),
        next_last=np.array(last, np.int16),
        experts=0,
    )


def ranges(
    kind: Ranges, actions: int, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Feasible actions, first and last inclusive."""
    begin = rng.integers(0, actions, count)
    if kind == "all":
        first, last = np.zeros(count), np.full(count, actions - 1)
    elif kind == "one":
        first = last = begin
    elif kind == "narrow":
        first, last = begin, begin + rng.integers(0, 5, count)
    elif kind == "straddle":
        edge = TILE * rng.integers(1, max(actions // TILE, 1) + 1, count)
        first, last = edge - rng.integers(0, 4, count), edge + rng.integers(0, 4, count)
    else:
        first, last = begin, begin + rng.integers(0, actions, count)
    top = actions - 1
    return np.clip(first, 0, top).astype(np.int16), np.clip(last, 0, top).astype(np.int16)


def random_batch(
    size: int,
    inputs: int,
    actions: int,
    kind: Ranges,
    rng: np.random.Generator,
    *,
    experts: int = 0,
) -> Batch:
    first, last = ranges(kind, actions, size, rng)
    next_first, next_last = ranges(kind, actions, size, rng)
    return Batch(
        inputs=rng.normal(size=(size, inputs)).astype(np.float32),
        action=rng.integers(first, last.astype(np.int64) + 1),
        reward=(2.0 * rng.normal(size=size)).astype(np.float32),
        discount=np.where(rng.random(size) < 0.2, 0.0, 0.95).astype(np.float32),
        next_inputs=rng.normal(size=(size, inputs)).astype(np.float32),
        first=first,
        last=last,
        next_first=next_first,
        next_last=next_last,
        experts=experts,
    )


class Reference:
    """Autograd and torch.optim.Adam in float64, every action computed."""

    def __init__(self, online: QNet, target: QNet, rule: Rule, rate: float) -> None:
        self.rule = rule
        self.online, self.target = self.tensors(online), self.tensors(target)
        for tensor in self.online:
            tensor.requires_grad_()
        self.adam = torch.optim.Adam(self.online, lr=rate)

    @staticmethod
    def tensors(net: QNet) -> list[torch.Tensor]:
        arrays = as_arrays(net)
        pairs = zip(arrays["weights"], arrays["biases"], strict=True)
        return [torch.from_numpy(x).double() for pair in pairs for x in pair]

    def q(self, net: list[torch.Tensor], inputs: np.ndarray) -> torch.Tensor:
        values = torch.from_numpy(inputs).double()
        for n in range(0, len(net), 2):
            if n:
                values = torch.tanh(values) if self.rule.tanh else torch.relu(values)
            values = values @ net[n].T + net[n + 1]
        return values

    def loss(self, batch: Batch) -> torch.Tensor:
        rows, index = torch.arange(len(batch.action)), np.arange(len(self.online[-1]))

        def masked(q: torch.Tensor, first: np.ndarray, last: np.ndarray) -> torch.Tensor:
            outside = (index < first[:, None]) | (index > last[:, None])
            return q.masked_fill(torch.from_numpy(outside), -torch.inf)

        with torch.no_grad():
            next_q = self.q(self.target, batch.next_inputs)
            chooser = self.q(self.online, batch.next_inputs) if self.rule.double else next_q
            best = masked(chooser, batch.next_first, batch.next_last).argmax(dim=1)
            y = torch.from_numpy(batch.reward).double()
            y = y + torch.from_numpy(batch.discount).double() * next_q[rows, best]
        q = self.q(self.online, batch.inputs)
        taken = q[rows, torch.from_numpy(batch.action)]
        if self.rule.huber:
            loss = torch.nn.functional.huber_loss(taken, y)
        else:
            loss = 0.5 * torch.nn.functional.mse_loss(taken, y)
        if self.rule.margin > 0.0 and batch.experts:
            distance = np.abs(index - batch.action[:, None]) / len(index)
            raised = q + self.rule.margin * torch.from_numpy(distance)
            rival = masked(raised, batch.first, batch.last).max(dim=1).values
            loss = loss + (rival - taken)[: batch.experts].sum() / len(rows)
        return loss

    def update(self, batch: Batch) -> float:
        loss = self.loss(batch)
        self.adam.zero_grad()
        loss.backward()
        self.adam.step()
        return loss.item()

    def difference(self, net: QNet) -> float:
        pairs = zip(self.tensors(net), self.online, strict=True)
        return max((mine - its).abs().max().item() for mine, its in pairs)


CASES: list[tuple[int, tuple[int, ...], int, Ranges, dict[str, bool]]] = [
    (1600, (64, 64), 64, "mixed", {}),
    (1600, (64, 64), 37, "straddle", {"double": False, "huber": False, "tanh": True}),
    (1600, (30,), 6, "narrow", {"huber": False}),
    (65, (24, 9, 13), 30, "all", {"tanh": True}),
    (65, (16,), 5, "one", {"double": False}),
    (65, (8, 8, 8), 1, "mixed", {"double": False, "tanh": True}),
    (TILE + 1, (20, 17), 11, "straddle", {"tanh": True, "huber": False}),
]


@pytest.mark.parametrize(("actions", "hidden", "size", "kind", "changed"), CASES)
def test_updates_equal_a_plain_reference(actions, hidden, size, kind, changed):
    """To 1e-6 after one update, to 1e-4 after 200 with moving batches and target net."""
    rng, rule = np.random.default_rng(5), rule_of(**changed)
    sizes = (3, *hidden, actions)
    online, target = random_net(sizes, rng), random_net(sizes, rng)
    adam, work = make_adam(sizes), make_workspace(sizes, size)
    reference = Reference(online, target, rule, 1e-3)
    batches = [random_batch(size, 3, actions, kind, rng) for _ in range(4)]
    for step in range(1, 201):
        batch = batches[step % 4]
        loss, _ = td_update(online, target, adam, work, batch, rule, 1e-3, step)
        assert loss == pytest.approx(reference.update(batch), rel=1e-3, abs=1e-5)
        if step == 1:
            assert reference.difference(online) < 1e-6
        if step % 50 == 0:
            move_target(target, online, 1.0)
            reference.target = [p.detach().clone() for p in reference.online]
    assert reference.difference(online) < 1e-4


@pytest.mark.parametrize("kind", ["mixed", "straddle", "one"])
@pytest.mark.parametrize("actions", [1600, 65])
def test_the_ordinal_margin_equals_a_plain_reference(actions: int, kind: Ranges):
    rng, rule = np.random.default_rng(8), rule_of(margin=0.8, huber=False)
    sizes = (3, 32, actions)
    online, target = random_net(sizes, rng), random_net(sizes, rng)
    adam, work = make_adam(sizes), make_workspace(sizes, 30)
    reference = Reference(online, target, rule, 1e-3)
    for step in range(1, 21):
        batch = random_batch(30, 3, actions, kind, rng, experts=17)
        loss, _ = td_update(online, target, adam, work, batch, rule, 1e-3, step)
        assert loss == pytest.approx(reference.update(batch), rel=1e-6)
        assert reference.difference(online) < (1e-6 if step == 1 else 1e-5)


def loss_of(online: QNet, target: QNet, batch: Batch, **changed: Any) -> float:
    """Half the squared error of a batch (and its margin); changes no net."""
    sizes = tuple(online.sizes)
    work = make_workspace(sizes, len(batch.action))
    rule = rule_of(huber=False, **changed)
    return td_update(copy_of(online), target, make_adam(sizes), work, batch, rule, 0.0, 1)[0]


def test_the_margin_by_hand():
    """Expert took 1 of 4; the rivals at distance 1, 1 and 2 are raised by 0.1, 0.1 and 0.2."""
    net = table_net([[1.0, 1.5, 1.2, 1.45]])
    terminal = rows_of([(0, 1, 1.5, 0.0, 0, 0, 3)], 1)
    expert = terminal._replace(experts=1, last=np.array([3], np.int16))
    assert loss_of(net, net, expert, margin=0.4) == pytest.approx(1.45 + 0.2 - 1.5, abs=1e-6)
    assert loss_of(net, net, expert, margin=0.1) == 0.0, "the expert's is best by its margin"
    narrow = expert._replace(last=np.array([2], np.int16))
    assert loss_of(net, net, narrow, margin=0.4) == 0.0, "action 3 is not feasible"
    assert loss_of(net, net, terminal, margin=0.4) == 0.0, "no expert's transition"


def test_margin_zero_is_no_margin_and_other_samples_are_untouched():
    """Experts first: what the margin does to a batch does not depend on who follows them."""
    rng = np.random.default_rng(9)
    sizes = (3, 12, 65)
    start, target = random_net(sizes, rng), random_net(sizes, rng)
    batch = random_batch(10, 3, 65, "mixed", rng, experts=4)
    after = {}
    for name, margin, experts in (("none", 0.0, 0), ("zero", 0.0, 4), ("nobody", 0.9, 0)):
        net = copy_of(start)
        rule, given = rule_of(margin=margin), batch._replace(experts=experts)
        td_update(net, target, make_adam(sizes), make_workspace(sizes, 10), given, rule, 1e-3, 1)
        after[name] = net.flat.tobytes()
    assert after["none"] == after["zero"] == after["nobody"]
    extra = loss_of(start, target, batch, margin=0.9) - loss_of(start, target, batch)
    experts = batch._replace(**{k: v[:4] for k, v in batch._asdict().items() if k != "experts"})
    alone = loss_of(start, target, experts, margin=0.9) - loss_of(start, target, experts)
    assert extra > 0.0
    assert extra * 10 == pytest.approx(alone * 4, rel=1e-4)


def test_double_target_by_hand_on_two_actions():
    """Online prefers action 1, target values it 3 although it values action 0 at 7."""
    online, target = table_net([[1.0, 2.0]]), table_net([[7.0, 3.0]])
    batch = rows_of([(0, 0, 0.5, 0.9, 0, 0, 1)], 1)
    double, single = 0.5 + 0.9 * 3.0, 0.5 + 0.9 * 7.0
    expected = [0.5 * (1.0 - y) ** 2 for y in (double, single)]
    assert loss_of(online, target, batch) == pytest.approx(expected[0], rel=1e-6)
    assert loss_of(online, target, batch, double=False) == pytest.approx(expected[1], rel=1e-6)


@MODES
@pytest.mark.parametrize("rows", [1, 4, 6])
def test_target_never_bootstraps_from_an_infeasible_action(double: bool, rows: int):
    """The best feasible action is worth 2, those beside the range 1e6, in both nets; the other
    rows of the batch, which share the arithmetic, may take those."""
    net = table_net([[1e6, 1.0, 2.0, 1e6], [0.0, 1e6, 1e6, 0.0]])
    mine, others = (0, 1, 0.0, 1.0, 0, 1, 2), (0, 1, 1.0, 0.0, 1, 0, 3)
    batch = rows_of([mine, *[others] * (rows - 1)], 2)
    assert loss_of(net, net, batch, double=double) * rows == pytest.approx(0.5 * (1.0 - 2.0) ** 2)


@MODES
def test_a_terminal_step_has_no_bootstrap(double: bool):
    net = table_net([[5.0, 6.0]])
    batch = rows_of([(0, 0, -1.5, 0.0, 0, 0, 1)], 1)
    assert loss_of(net, net, batch, double=double) == pytest.approx(0.5 * 6.5**2)


@pytest.mark.parametrize("tanh", [False, True])
@pytest.mark.parametrize("actions", [1600, 65, TILE])
def test_best_actions_are_those_of_the_numpy_network(actions: int, tanh: bool):
    rng = np.random.default_rng(2)
    sizes, kinds = (5, 33, 18, actions), ("all", "one", "narrow", "straddle", "mixed")
    net, work = random_net(sizes, rng), make_workspace(sizes, 31)
    inputs = rng.normal(size=(31, 5)).astype(np.float32)
    q = mlp.forward(mlp.Mlp(**as_arrays(net), activation="tanh" if tanh else "relu"), inputs)
    forward(net, inputs, work.layers, tanh)
    index = np.arange(actions)
    for kind in kinds:
        first, last = ranges(kind, actions, 31, rng)
        best_actions(net, work.layers[-1], first, last, 31, work)
        masked = np.where((index < first[:, None]) | (index > last[:, None]), -np.inf, q)
        assert np.abs(work.best - masked.max(axis=1)).max() < 1e-6
        assert np.array_equal(work.chosen, masked.argmax(axis=1))
        values = [value_of(net, work.layers[-1], b, int(a)) for b, a in enumerate(work.chosen)]
        assert np.abs(values - work.best).max() < 1e-6


def test_of_equal_actions_the_first_feasible_one_is_best():
    net, work = zero_net((1, 600)), make_workspace((1, 600), 3)
    first, last = np.array([0, 300, 255], np.int16), np.array([599, 310, 520], np.int16)
    best_actions(net, work.layers[-1], first, last, 3, work)
    assert work.chosen.tolist() == [0, 300, 255]


def test_a_larger_batch_before_leaves_nothing_behind():
    """Rows that a smaller batch does not fill keep old activations; they must not count."""
    rng = np.random.default_rng(4)
    sizes = (3, 10, 10, 65)
    start, target = random_net(sizes, rng), random_net(sizes, rng)
    large, small = (random_batch(n, 3, 65, "mixed", rng) for n in (40, 5))
    after = []
    for before in (large, None):
        work, rule = make_workspace(sizes, 40), rule_of()
        if before is not None:
            td_update(copy_of(start), target, make_adam(sizes), work, before, rule, 1e-3, 1)
        net = copy_of(start)
        td_update(net, target, make_adam(sizes), work, small, rule, 1e-3, 1)
        after.append(net.flat.tobytes())
    assert after[0] == after[1]


def test_hard_target_updates_copy_and_soft_ones_approach():
    rng = np.random.default_rng(0)
    online, target = random_net((2, 3), rng), random_net((2, 3), rng)
    before = target.flat.copy()
    move_target(target, online, 0.25)
    assert np.allclose(target.flat, before + 0.25 * (online.flat - before), atol=1e-7)
    move_target(target, online, 1.0)
    assert np.array_equal(target.flat, online.flat)


def test_moments_without_gradient_become_zero_and_never_denormal():
    """Action 0 is taken once, then never again; its mean would reach denormals in 900 updates."""
    rng = np.random.default_rng(1)
    sizes = (2, 8, 3)
    online, target = random_net(sizes, rng), random_net(sizes, rng)
    adam, work = make_adam(sizes), make_workspace(sizes, 4)
    batch = random_batch(4, 2, 3, "all", rng)
    adam.square[:] = 1e-29
    smallest = np.finfo(np.float32).tiny
    for step in range(1, 4001):
        given = batch._replace(action=np.full(4, 0 if step == 1 else 1))
        td_update(online, target, adam, work, given, rule_of(), 1e-3, step)
        if step % 100 == 0:
            for moments in (adam.mean, adam.square):
                assert not np.any((moments != 0.0) & (np.abs(moments) < smallest))
    never = [weights[2] for weights in as_arrays(net_of(sizes, adam.square))["weights"][1:]]
    once = [weights[0] for weights in as_arrays(net_of(sizes, adam.mean))["weights"][1:]]
    assert np.array_equal(never, np.zeros_like(never))
    assert np.array_equal(once, np.zeros_like(once))


def bandit_value(double: bool, seed: int) -> float:
    """Learned value of a step into a bandit of ten arms that pay noise of mean 0; true value 0."""
    rng = np.random.default_rng(seed)
    sizes = (2, 10)
    online, target = random_net(sizes, rng), zero_net(sizes)
    adam, work = make_adam(sizes), make_workspace(sizes, 11)
    seen = []
    for step in range(1, 3001):
        arms = [(1, arm, rng.normal(), 0.0, 1, 0, 9) for arm in range(10)]
        batch = rows_of([(0, 0, 0.0, 0.9, 1, 0, 9), *arms], 2)
        rule = rule_of(double=double, huber=False)
        td_update(online, target, adam, work, batch, rule, 0.05, step)
        if step % 200 == 0:
            move_target(target, online, 1.0)
        if step > 1000:
            seen.append(online.flat[0] + online.flat[20])
    return float(np.mean(seen))


def test_double_overestimates_less_on_a_noisy_bandit():
    """Over five seeds: single by more than 0.2, double by less than a third of single."""
    single, double = ([bandit_value(mode, seed) for seed in range(5)] for mode in (False, True))
    assert np.mean(single) > 0.2
    assert np.mean(np.abs(double)) < np.mean(single) / 3.0
    assert all(d < s for d, s in zip(double, single, strict=True))


def test_a_net_is_a_view_of_its_flat_vector():
    sizes = (3, 4, 2)
    flat = np.zeros(parameters(sizes), np.float32)
    net = net_of(sizes, flat)
    flat[:] = np.arange(len(flat))
    arrays = as_arrays(net)
    assert [w.shape for w in arrays["weights"]] == [(4, 3), (2, 4)]
    assert arrays["biases"][1].tolist() == [24.0, 25.0]
    assert arrays["weights"][0][1].tolist() == [1.0, 5.0, 9.0], "inputs of the second unit"
