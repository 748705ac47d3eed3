"""Colosseum's DeepSea: deep sea in which a dive follows another one, and every choice of left pays a little."""

from dataclasses import dataclass

from pharos.environments.base import Environment, Look, parameter, store
from pharos.environments.worlds.deep_sea import DeepSea


@dataclass(frozen=True, kw_only=True)
class EndlessSea(DeepSea):
    """Dive through `size` rows again and again, to the left or to the right in each.

    State    (row, column), as in `deep_sea`.
    Actions  as in `deep_sea`.
    Chance   with `p_rand` an action that is drawn evenly is executed, while the choice pays.
    Reward   1 for choosing right in the last column, left_reward for choosing left.
    Ends     never: the last row leads to the start.
    Limit    `size` steps: a dive, Colosseum's episode.
    Ours     Colosseum's actions change their numbers from state to state, which no measure of hardness notices.
    Source   DeepSea of Colosseum; Conserva and Rauber (2022), "Hardness in Markov decision processes: theory and
             practice".

    Attributes:
        size: rows and columns, at least 2.
        stochastic: whether going right may fail.
        mapping_seed: of the actions, as bsuite draws them. None: the second action goes right everywhere.
        move_cost: of going right every time.
        left_reward: for each choice of left. None stands for 1 / size^2.
        p_rand: from 0 to 0.9999.
    """

    move_cost: float = parameter(0.0, low=0.0)
    left_reward: float = parameter(None, kind=float)

    name = "endless_sea"
    version = 1
    restarts = True
    look = Look(color="#661100")
    instances = {"10x10": {}, "20x20-random": {"size": 20, "p_rand": 0.1}}
    hyperparameters = {  # chosen by hand
        "q_learning": {"default": {"gamma": 0.95, "initial_q": 5.0}},
        "dqn": {"default": {"gamma": 0.95, "learning_rate": 0.001, "exploration_fraction": 0.5}},
    }
    age = Environment.age  # rows come again: no age

    def validate(self) -> None:
        if self.left_reward is None:
            store(self, "left_reward", 1 / self.size**2)
