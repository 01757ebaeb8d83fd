"""What a plan's calibration will be worth, and the photos that cure it, under one name."""

from mission.fixing import Fix, fix
from mission.planned_network import Assumptions
from mission.prediction import Prediction, predict
from mission.terrain_height import LevelGround, Terrain

__all__ = ["Assumptions", "Fix", "LevelGround", "Prediction", "Terrain", "fix", "predict"]
