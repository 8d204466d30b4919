import gymnasium as gym
import mujoco
import numpy as np

MODEL = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/>
<geom type="capsule" size="0.05" fromto="0 0 0 0 0 0.5"/></body></worldbody>
<actuator><motor joint="hinge" gear="5"/></actuator></mujoco>"""


class Swing(gym.Env):
    """One joint."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(MODEL)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[0] = self.np_random.uniform(-1, 1)
        return self._observation(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=5)
        return self._observation(), float(np.cos(self.data.qpos[0])), False, False, {}

    def _observation(self):
        return np.concatenate([self.data.qpos, self.data.qvel])


def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Swing] * n_envs)
