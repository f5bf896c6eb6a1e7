from .capture import Capture as Capture
from .inspect import CaptureReport as CaptureReport
from .inspect import inspect_capture as inspect_capture
from .views import CapturedView as CapturedView
