"""HDR-IL for LeRobot. LeRobot imports this module at start, by its name; that registers ``--policy.type=hdril``."""

from contextlib import suppress

from lerobot_policy_hdril.configuration_hdril import HDRILConfig
from lerobot_policy_hdril.modeling_hdril import HDRILPolicy
from lerobot_policy_hdril.processor_hdril import make_hdril_pre_post_processors

# With the simulator installed, --env.type=hdril comes along. The policy does not need it.
with suppress(ModuleNotFoundError):
    import hdril.lerobot_env  # noqa: F401

__all__ = ["HDRILConfig", "HDRILPolicy", "make_hdril_pre_post_processors"]
