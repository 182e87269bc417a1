"""An adapter in a package of its own: MuJoCo under another name."""

from adapters.mujoco_engine import Mujoco


class Renamed(Mujoco):
    name = "renamed"
    title = "Renamed"
