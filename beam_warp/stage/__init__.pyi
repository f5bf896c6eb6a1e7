from .stage import Stage as Stage
