import gymnasium as gym
import networkx as nx


class Walk(gym.Env):
    """Goes from member to member of a karate club."""

    def __init__(self):
        self.graph = nx.karate_club_graph()
        self.observation_space = gym.spaces.Discrete(len(self.graph))
        self.action_space = gym.spaces.Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = int(self.np_random.integers(len(self.graph)))
        return self.at, {}

    def step(self, action):
        near = sorted(self.graph.neighbors(self.at))
        self.at = near[action % len(near)]
        return self.at, float(self.graph.degree[self.at]), self.at == 33, False, {}


def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Walk] * n_envs)
