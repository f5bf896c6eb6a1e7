from .asset import evaluate_asset as evaluate_asset
from .materials import EvaluateOptions as EvaluateOptions
from .materials import MaterialScores as MaterialScores
from .materials import score_materials as score_materials
