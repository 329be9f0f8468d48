"""A copy of a checkpoint with the model of one primitive damaged: all its weights are zero.

python scripts/damage.py outputs/demo/train/checkpoints/last/pretrained_model outputs/damaged lift
python scripts/damage.py outputs/demo/train/checkpoints/last/pretrained_model outputs/linear --linear

The first copy fails for a known reason. Tools that look for reasons can be tried on it. The second one keeps the planner and the
linear maps, and its networks predict nothing beside them: what it does, the linear maps do alone.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from pathlib import Path


def damage(checkpoint: Path, output: Path, primitive: str) -> None:
    """Write the damaged copy.

    Raises:
        FileExistsError: there is something at ``output``.
        ValueError: it is no HDR-IL policy, or has no model for this primitive alone.
    """
    from lerobot_policy_hdril import HDRILConfig

    config = HDRILConfig.from_pretrained(checkpoint)
    if not isinstance(config, HDRILConfig):
        raise ValueError(f"{checkpoint} is a policy of type {config.type!r}, not hdril")
    own = config.primitives if config.per_primitive else []
    if primitive not in own:
        raise ValueError(f"no model of its own for {primitive!r}; there is one for: {', '.join(own) or 'none'}")
    _zero(checkpoint, output, re.compile(rf"dynamics\.{own.index(primitive)}\."))


def leave_linear_maps(checkpoint: Path, output: Path) -> None:
    """Write a copy whose networks predict nothing beside the linear maps: the last layers of their heads are zero.

    Raises:
        FileExistsError: there is something at ``output``.
        ValueError: it is no HDR-IL policy, or has no linear maps.
    """
    from lerobot_policy_hdril import HDRILConfig

    config = HDRILConfig.from_pretrained(checkpoint)
    if not isinstance(config, HDRILConfig) or not config.state_skip:
        raise ValueError(f"{checkpoint} has no linear maps: it is a policy of type {config.type!r} without state_skip")
    _zero(checkpoint, output, re.compile(r"dynamics\.\d+\.head\.2\."))


def _zero(checkpoint: Path, output: Path, names: re.Pattern[str]) -> None:
    """Write a copy in which the weights of these names are zero."""
    from safetensors.torch import load_file, save_file

    if output.exists():
        raise FileExistsError(f"{output} exists; choose another folder or delete it")
    weights = load_file(checkpoint / "model.safetensors")
    chosen = [value for name, value in weights.items() if names.match(name)]
    if not chosen:
        raise ValueError(f"{checkpoint} has no weights whose names match {names.pattern}")
    for value in chosen:
        value.zero_()
    shutil.copytree(checkpoint, output)
    save_file(weights, output / "model.safetensors")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("primitive", nargs="?", help="whose model is damaged")
    parser.add_argument("--linear", action="store_true", help="leave the linear maps of all primitives alone")
    options = parser.parse_args()
    if options.linear == (options.primitive is not None):
        parser.error("give a primitive or --linear")
    try:
        if options.linear:
            leave_linear_maps(options.checkpoint, options.output)
        else:
            damage(options.checkpoint, options.output, options.primitive)
    except (FileExistsError, FileNotFoundError, ValueError) as error:
        sys.exit(f"damage: {error}")
    print(f"{options.output}: {'linear maps alone' if options.linear else f'{options.primitive} is damaged'}")


if __name__ == "__main__":
    main()
