"""Loading of a checkpoint's weights: all of them, or an error."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn


def load_weights(model: nn.Module, path: Path, device: str) -> None:
    """Copy the tensors of a safetensors file into a model.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, or its tensors are not those of the model. LeRobot would log that and leave the
            missing ones random.
    """
    if not path.is_file():
        raise FileNotFoundError(f"the checkpoint has no weights: {path} is not there")
    try:
        tensors = load_file(path, device=device)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path} is not a whole safetensors file: download or save it again ({error})") from None
    expected = model.state_dict()
    _refuse(path, "lacks", expected.keys() - tensors.keys())
    _refuse(path, "has unknown", tensors.keys() - expected.keys())
    wrong = {name for name, value in expected.items() if tensors[name].shape != value.shape}
    _refuse(path, "has other shapes of", wrong)
    model.load_state_dict(tensors)


def _refuse(path: Path, what: str, names: set[str]) -> None:
    if names:
        shown = ", ".join(sorted(names)[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        raise ValueError(f"{path} does not fit its config.json: it {what} {shown}")
