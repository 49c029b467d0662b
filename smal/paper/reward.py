"""Reward by inverse reinforcement learning: the linear program of Ng & Russell (2000) for a known finite model.

    maximize   sum_s min_{a != a1} [(P_a1(s) - P_a(s)) V] - lambda ||R||_1
    such that  (P_a1(s) - P_a(s)) V >= 0 for every s and a,   V = R + gamma P_a1 V,   |R| <= Rmax = 1

with a1 the action that the expert took most often in s (`Transitions.expert_pairs`). V stays a variable, instead of
(I - gamma P_a1)^-1 R, so that every matrix is sparse.

Two departures. Demonstrations contain few actions per state, and P_a is unknown for the others. We send every other
(s, a) to a sink of value zero; without it most states have no constraint, and R = 0 is optimal. And lambda is a share
of the value above which R = 0 is optimal, because its scale depends on the number of states. Near 1 only the most
important states have a reward. That value is the optimum of the same program with ||R||_1 <= 1 in place of the penalty,
since margins are proportional to R.

The program makes the expert's policy optimal under R. That R is not unique (R = 0 does so too, by ties); the
objective selects an R under which the margin of the expert's actions is largest.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from smal.arrays import Floats
from smal.paper.policy import check_discount, policy_matrix
from smal.paper.transitions import Transitions


class RewardError(RuntimeError):
    """The linear program was not solved."""


class Reward(NamedTuple):
    """R(s) of every state (states,), within [-1, 1], and the optimal value of the program."""

    state_reward: Floats
    objective: float


class _Program:
    """The constraints, with variables V (n, free), R+ and R- (n each, not negative) and margin (n, not negative).

    margin(s) <= every advantage in s also implies that advantages are not negative. A dead end has no advantage, and
    its margin is 0.
    """

    def __init__(self, transitions: Transitions, gamma: float) -> None:
        self.n = n = transitions.states
        expert = transitions.expert_pairs()
        P = policy_matrix(transitions, expert)
        # Rows P_a1(s) - P_a(s) for every demonstrated alternative a and for the sink, and the state of each row.
        T = transitions.matrix
        acting = np.flatnonzero(expert >= 0)
        rival = np.flatnonzero(expert[transitions.state] != np.arange(transitions.pairs))
        rival_state = transitions.state[rival]
        over_rivals = T[expert[rival_state]] - T[rival]
        over_sink = T[expert[acting]]
        advantage = sparse.vstack([over_rivals, over_sink], format="csr")
        of_state = np.concatenate([rival_state, acting])
        self.rows = rows = of_state.size
        margin = sparse.csr_array((np.ones(rows), (np.arange(rows), of_state)), shape=(rows, n))
        identity = sparse.eye_array(n, format="csr")
        no_reward = sparse.csr_array((rows, 2 * n))
        no_margin = sparse.csr_array((n, n))
        bellman = identity - gamma * P
        self.inequality = sparse.hstack([-advantage, no_reward, margin], format="csr")
        self.equality = sparse.hstack([bellman, -identity, identity, no_margin], format="csr")
        self.margin_bound = np.where(expert >= 0, np.inf, 0.0)

    def solve(self, penalty: float, total: float = np.inf) -> tuple[Floats, float]:
        """Maximize the margins less `penalty` ||R||_1, with |R| <= 1 and ||R||_1 <= total: variables, optimum."""
        n = self.n
        # The last row is ||R||_1 <= total.
        sum_of_reward = sparse.csr_array(np.repeat([0.0, 1.0, 0.0], [n, 2 * n, n])[None])
        unbounded = np.full(n, np.inf)
        low = [-unbounded, np.zeros(3 * n)]
        high = [unbounded, np.ones(2 * n), self.margin_bound]
        cost = np.concatenate([np.zeros(n), np.full(2 * n, penalty), -np.ones(n)])
        result = linprog(  # type: ignore[call-overload]  # the stubs lack sparse matrices
            cost,
            A_ub=sparse.vstack([self.inequality, sum_of_reward], format="csr"),
            b_ub=np.append(np.zeros(self.rows), min(total, 2.0 * n)),
            A_eq=self.equality,
            b_eq=np.zeros(n),
            bounds=np.stack([np.concatenate(low), np.concatenate(high)], axis=1),
            method="highs",
        )
        if not result.success:
            raise RewardError(f"the reward program of {n} states was not solved: {result.message}")
        return np.asarray(result.x, dtype=np.float64), -float(result.fun)


def learn_reward(transitions: Transitions, gamma: float, sparsity: float = 0.5) -> Reward:
    """Find a reward under which the expert's majority policy is optimal; RewardError if HiGHS does not solve it.

    `sparsity` is lambda as a share, 0 to 1, of its critical value (see the module). ValueError if it, or `gamma`,
    is out of range.
    """
    check_discount(gamma)
    if not 0.0 <= sparsity <= 1.0:
        raise ValueError(f"sparsity must be 0 to 1, got {sparsity}")
    program = _Program(transitions, gamma)
    _, critical = program.solve(penalty=0.0, total=1.0)
    x, objective = program.solve(sparsity * critical)
    n = transitions.states
    positive = x[n : 2 * n]
    negative = x[2 * n : 3 * n]
    return Reward(positive - negative, objective)
