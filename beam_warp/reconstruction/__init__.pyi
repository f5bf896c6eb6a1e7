from .fit import FitOptions as FitOptions
from .fit import fit_gaussians as fit_gaussians
from .initial import initial_gaussians as initial_gaussians
from .job import Reconstruction as Reconstruction
from .job import ReconstructOptions as ReconstructOptions
from .job import reconstruct as reconstruct
from .steps import FitAndTrack as FitAndTrack
from .track import TrackOptions as TrackOptions
