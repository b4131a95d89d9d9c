"""Vector environments and their wrappers."""

import sys

from rejeu.sb3.common.vec_env import adapters
from rejeu.sb3.common.vec_env.base_vec_env import VecEnv, VecEnvWrapper, is_vecenv_wrapped, unwrap_vec_wrapper
from rejeu.sb3.common.vec_env.dummy_vec_env import DummyVecEnv
from rejeu.sb3.common.vec_env.stacked_observations import StackedObservations
from rejeu.sb3.common.vec_env.subproc_vec_env import SubprocVecEnv
from rejeu.sb3.common.vec_env.vec_check_nan import VecCheckNan
from rejeu.sb3.common.vec_env.vec_extract_dict_obs import VecExtractDictObs
from rejeu.sb3.common.vec_env.vec_frame_stack import VecFrameStack
from rejeu.sb3.common.vec_env.vec_monitor import VecMonitor
from rejeu.sb3.common.vec_env.vec_normalize import VecNormalize, sync_envs_normalization, unwrap_vec_normalize
from rejeu.sb3.common.vec_env.vec_transpose import VecTransposeImage
from rejeu.sb3.common.vec_env.vec_video_recorder import VecVideoRecorder
from rejeu.sb3.modules import passes_on

for _path in [path for path in sys.modules if path.startswith(f"{__name__}.")]:
    passes_on(_path)
