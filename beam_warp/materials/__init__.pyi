from .direct import MaterialOptions as MaterialOptions
from .images import ImagePathOptions as ImagePathOptions
from .job import OverviewOptions as OverviewOptions
from .job import RunOptions as RunOptions
from .job import RunResult as RunResult
from .job import run as run
from .normals import SurfaceNormals as SurfaceNormals
from .normals import estimate_normals as estimate_normals
