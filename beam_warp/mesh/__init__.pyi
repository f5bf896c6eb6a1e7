from .consistency import depth_consistency as depth_consistency
from .distances import surface_distances as surface_distances
from .extract import mesh_of_gaussians as mesh_of_gaussians
from .extract import surrounding_cameras as surrounding_cameras
from .files import read_mesh as read_mesh
from .files import write_mesh as write_mesh
from .fusion import fuse_depths as fuse_depths
from .topology import mesh_report as mesh_report
