"""Vector environments that reset themselves."""

from rejeu.envs.auto_reset import DummyVecEnv, VecVideoRecorder
from rejeu.envs.subproc import SubprocVecEnv
from rejeu.envs.vec_env import VecEnv, VecEnvWrapper, is_vecenv_wrapped, unwrap_vec_wrapper
from rejeu.envs.vec_normalize import VecNormalize, sync_envs_normalization, unwrap_vec_normalize
from rejeu.envs.vec_wrappers import VecCheckNan, VecExtractDictObs, VecFrameStack, VecMonitor, VecTransposeImage

__all__ = [
    "DummyVecEnv",
    "SubprocVecEnv",
    "VecCheckNan",
    "VecEnv",
    "VecEnvWrapper",
    "VecExtractDictObs",
    "VecFrameStack",
    "VecMonitor",
    "VecNormalize",
    "VecTransposeImage",
    "VecVideoRecorder",
    "is_vecenv_wrapped",
    "sync_envs_normalization",
    "unwrap_vec_normalize",
    "unwrap_vec_wrapper",
]
