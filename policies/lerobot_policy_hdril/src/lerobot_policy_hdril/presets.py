"""The models of the paper (Section 5.1, Tables 1 and 2) and ours, by name, as values of the config."""

from __future__ import annotations

from typing import Any

# One latent per sample, five averaged at test time, and no KL term: what the authors' released code does.
_AUTHORS = {"state_skip": False, "latent": "variational", "kl_weight": 0.0, "samples": 5}
_FEATURES: dict[str, dict[str, Any]] = {
    "gru_gru": {"interaction": "none", "skip": False},
    "res": {"interaction": "none", "skip": True},
    "int": {"interaction": "scalar", "skip": False},
    "resint": {"interaction": "scalar", "skip": True},
}
# A model for all primitives is wider, to have about as many parameters as six small ones together (paper, appendix A.1).
_SINGLE_HIDDEN, _MULTI_HIDDEN = {"none": 322, "scalar": 410}, 128
PLAIN: dict[str, Any] = {
    "termination": "length",
    "filter_frames": 1,
    "long_filter_frames": 1,
    "robust": False,
    "hand_noise": 0.0,
    "split_forms": False,
    "planner_balance": 0.0,
    "planner_dropout": 0.0,
    "planner_late": 0.0,
    "planner_scale": 0.0,
    "least_survival": 0.0,
    "repeat_discount": 0.0,
    "replan_every": 0,
    "plan_overlap": 0,
}
"""What the paper's models have: they look once a primitive, or never, and learn from all that they are shown."""


def _presets() -> dict[str, dict[str, Any]]:
    absolute: dict[str, dict[str, Any]] = {}
    for name, features in _FEATURES.items():
        single = {"per_primitive": False, "hidden_dim": _SINGLE_HIDDEN[features["interaction"]]}
        absolute[name] = PLAIN | _AUTHORS | features | single
    for name, features in _FEATURES.items():
        multi = "hdril_paper" if name == "resint" else f"{name}_multi"
        absolute[multi] = PLAIN | _AUTHORS | features | {"per_primitive": True, "hidden_dim": _MULTI_HIDDEN}
    every = {name: values | {"coordinates": "absolute", "decoder": "gru"} for name, values in absolute.items()}
    every |= {f"{name}_relational": values | {"coordinates": "relational"} for name, values in every.items()}
    every["hdril_paper_ode"] = every["hdril_paper"] | {"decoder": "ode"}
    every["hdril"] = PLAIN | {
        "interaction": "object",
        "skip": True,
        "state_skip": True,
        "per_primitive": True,
        "coordinates": "absolute",
        "decoder": "gru",
        "latent": "deterministic",
        "kl_weight": 0.0,
        "samples": 0,
        "hidden_dim": _MULTI_HIDDEN,
    }
    every["linear"] = every["hdril"] | {"decoder": "linear"}
    every["linear_every_frame"] = every["linear"] | {"replan_every": 1}
    every["hdril_reactive"] = every["hdril"] | {
        "coordinates": "fused",
        "termination": "learned",
        "filter_frames": 8,
        "long_filter_frames": 24,
        "robust": True,
        "hand_noise": 0.005,
        "split_forms": True,
        "planner_balance": 0.5,
        "planner_dropout": 0.2,
        "planner_late": 0.5,
        "planner_scale": 0.05,
        "least_survival": 0.3,
        "repeat_discount": 0.5,
        "replan_every": 2,
        "plan_overlap": 1,
        "decoder": "linear",
    }
    every["network_reactive"] = every["hdril_reactive"] | {"decoder": "gru"}
    return every


PRESETS: dict[str, dict[str, Any]] = _presets()
"""Fields of :class:`~lerobot_policy_hdril.HDRILConfig` by preset."""
