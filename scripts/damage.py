"""A copy of a checkpoint with the model of one primitive damaged: all its weights are zero, and its linear maps.

python scripts/damage.py outputs/demo/train/checkpoints/last/pretrained_model outputs/damaged lift

The copy fails for a known reason. Tools that look for reasons can be tried on it.
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
        ValueError: it is no HDR-IL policy, or has no model for this primitive alone.
    """
    from lerobot_policy_hdril import HDRILConfig
    from safetensors.torch import load_file, save_file

    config = HDRILConfig.from_pretrained(checkpoint)
    if not isinstance(config, HDRILConfig):
        raise ValueError(f"{checkpoint} is a policy of type {config.type!r}, not hdril")
    own = config.primitives if config.per_primitive else []
    if primitive not in own:
        raise ValueError(f"no model of its own for {primitive!r}; there is one for: {', '.join(own) or 'none'}")
    if output.exists():
        raise FileExistsError(f"{output} exists; choose another folder or delete it")
    weights = load_file(checkpoint / "model.safetensors")
    forms = [k for k, name in enumerate(config.form_names) if name == primitive]
    mine = tuple(f"{part}.{k}." for part in ("dynamics", "fused") for k in forms)
    for name, value in weights.items():
        # Predictions without precision could not be fused.
        if name.startswith(mine) and not name.endswith((".whitening", ".agreement", ".variance")):
            value.zero_()
    shutil.copytree(checkpoint, output)
    save_file(weights, output / "model.safetensors")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("primitive", help="whose model is damaged")
    options = parser.parse_args()
    try:
        damage(options.checkpoint, options.output, options.primitive)
    except (FileExistsError, FileNotFoundError, ValueError) as error:
        sys.exit(f"damage: {error}")
    print(f"{options.output}: {options.primitive} is damaged")


if __name__ == "__main__":
    main()
