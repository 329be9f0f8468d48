"""A copy of a checkpoint with the model of one primitive damaged: all its weights are zero.

python scripts/damage.py outputs/demo/train/checkpoints/last/pretrained_model outputs/damaged lift

A policy that fails for a known reason, to try tools on that are to find the reason.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path


def damage(checkpoint: Path, output: Path, primitive: str) -> None:
    """Write the damaged copy.

    Raises:
        FileExistsError: there is something at ``output``.
        ValueError: the policy has no model for such a primitive alone.
    """
    from lerobot_policy_hdril import HDRILConfig
    from safetensors.torch import load_file, save_file

    config = HDRILConfig.from_pretrained(checkpoint)
    if primitive not in config.primitives or not config.per_primitive:  # pyright: ignore
        names = config.primitives if config.per_primitive else []  # pyright: ignore
        raise ValueError(f"no model of its own for {primitive!r}; there is one for: {', '.join(names) or 'none'}")
    if output.exists():
        raise FileExistsError(f"{output} exists; choose another folder or delete it")
    weights = load_file(checkpoint / "model.safetensors")
    prefix = f"dynamics.{config.primitives.index(primitive)}."  # pyright: ignore
    for name, value in weights.items():
        if name.startswith(prefix):
            value.zero_()
    shutil.copytree(checkpoint, output)
    save_file(weights, output / "model.safetensors")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("primitive")
    options = parser.parse_args()
    try:
        damage(options.checkpoint, options.output, options.primitive)
    except (FileExistsError, FileNotFoundError, ValueError) as error:
        sys.exit(f"damage: {error}")
    print(f"{options.output}: {options.primitive} is damaged")


if __name__ == "__main__":
    main()
