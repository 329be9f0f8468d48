"""Nothing is drawn in these tests."""

import os

os.environ.setdefault("MUJOCO_GL", "disable")  # read when MuJoCo is imported
