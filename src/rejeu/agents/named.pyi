"""The agents of the catalog, for type checkers and editors; ``tests/test_typing.py`` compares it with the catalog."""

from rejeu.agents.agent import Agent
from rejeu.agents.off_policy import OffPolicyAgent
from rejeu.agents.on_policy import OnPolicyAgent

BUILT_IN: dict[str, type[Agent]]

class SAC(OffPolicyAgent):
    """Soft actor-critic (Haarnoja et al. 2018), for Box and Discrete actions, and Dict and Tuple of any kind."""

class DDPG(OffPolicyAgent):
    """Deep deterministic policy gradient (Lillicrap et al. 2015), for continuous and Discrete actions."""

class TD3(OffPolicyAgent):
    """Twin delayed DDPG (Fujimoto et al. 2018), for continuous actions."""

class DQN(OffPolicyAgent):
    """Deep Q-learning (Mnih et al. 2015), for Discrete actions; with the parts of Rainbow, C51 among them, by option."""

class QRDQN(OffPolicyAgent):
    """Quantile regression DQN (Dabney et al. 2018), for Discrete actions."""

class IQN(OffPolicyAgent):
    """Implicit quantile networks (Dabney et al. 2018), for Discrete actions."""

class TQC(OffPolicyAgent):
    """Truncated quantile critics (Kuznetsov et al. 2020), for continuous actions."""

class REDQ(OffPolicyAgent):
    """SAC with 20 gradient steps of 10 critics for each step (Chen et al. 2021), for the actions of SAC."""

class CrossQ(OffPolicyAgent):
    """SAC with batch renormalization instead of target networks (Bhatt et al. 2024), for continuous actions."""

class FlashSAC(OffPolicyAgent):
    """SAC through normalized, projected networks and categorical critics (Kim et al. 2026), for continuous actions."""

class XQC(OffPolicyAgent):
    """SAC through batch-normalized, projected layers and categorical critics (Palenicek et al. 2026), likewise."""

class PPO(OnPolicyAgent):
    """Proximal policy optimization (Schulman et al. 2017), for Box, Discrete, MultiDiscrete and MultiBinary actions."""

class A2C(OnPolicyAgent):
    """Advantage actor-critic (Mnih et al. 2016), for Box, Discrete, MultiDiscrete and MultiBinary actions."""

class RecurrentPPO(OnPolicyAgent):
    """PPO with an LSTM or GRU before the hidden layers, for partially observable environments."""

class MaskablePPO(OnPolicyAgent):
    """PPO with ``action_masks=True``: masks of the allowed actions, from the environment (Huang and Ontanon 2022)."""

class PQN(OnPolicyAgent):
    """Parallelized Q-network (Gallici et al. 2024), Q-learning from rollouts for Discrete actions."""

class TRPO(OnPolicyAgent):
    """Trust region policy optimization (Schulman et al. 2015), for Box, Discrete, MultiDiscrete and MultiBinary actions."""

class ARS(OnPolicyAgent):
    """Augmented random search (Mania et al. 2018), without gradients, for Box and Discrete actions."""

class IQL(OffPolicyAgent):
    """Implicit Q-learning from recorded episodes (Kostrikov et al. 2022), for continuous actions."""

class TD3BC(OffPolicyAgent):
    """TD3 with behavior cloning, from recorded episodes (Fujimoto & Gu 2021), for continuous actions."""

class ReBRAC(OffPolicyAgent):
    """TD3 with penalties on actor and critic, from recorded episodes (Tarasov et al. 2023), for continuous actions."""
