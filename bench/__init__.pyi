from .methods.protocol import ForceEstimate as ForceEstimate
from .methods.protocol import FrameMotion as FrameMotion
from .methods.protocol import Method as Method
from .methods.protocol import MethodContext as MethodContext
from .recording.from_sequence import export_recording as export_recording
from .scoring.result import Result as Result
from .scoring.score import Settings as Settings
from .scoring.score import score as score
