"""HDR-IL for LeRobot. LeRobot imports this module at start, by its name; that registers ``--policy.type=hdril``, and the
baseline ``--policy.type=nearest``.

Other packages that are to be imported along, such as the simulator's ``--env.type=hdril``, say so by an entry point of the
group ``lerobot_policy_hdril.companions``. The policy needs none of them.
"""

from lerobot_policy_hdril.companions import load_companions
from lerobot_policy_hdril.configuration_hdril import HDRILConfig
from lerobot_policy_hdril.configuration_nearest import NearestConfig
from lerobot_policy_hdril.explain import Attention, Explanation
from lerobot_policy_hdril.modeling_hdril import HDRILPolicy
from lerobot_policy_hdril.modeling_nearest import NearestPolicy
from lerobot_policy_hdril.processor_hdril import make_hdril_pre_post_processors

__all__ = [
    "Attention",
    "Explanation",
    "HDRILConfig",
    "HDRILPolicy",
    "NearestConfig",
    "NearestPolicy",
    "make_hdril_pre_post_processors",
]

load_companions()
