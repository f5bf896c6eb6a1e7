from .job import RunResult as RunResult
from .job import run as run
from .options import OverviewOptions as OverviewOptions
from .options import RunOptions as RunOptions
