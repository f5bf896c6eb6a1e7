from .asset import EvaluateOptions as EvaluateOptions
from .asset import evaluate_asset as evaluate_asset
from .materials import MaterialScores as MaterialScores
from .materials import score_materials as score_materials
