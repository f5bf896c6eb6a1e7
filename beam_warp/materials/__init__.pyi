from .images import ImagePathOptions as ImagePathOptions
from .light_rays import MaterialOptions as MaterialOptions
from .normals import SurfaceNormals as SurfaceNormals
from .normals import estimate_normals as estimate_normals
