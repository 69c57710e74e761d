from bench.methods.protocol import ForceEstimate as ForceEstimate
from bench.methods.protocol import Method as Method
from bench.methods.protocol import MethodContext as MethodContext
from bench.recording.from_sequence import export_recording as export_recording
from bench.scoring.result import Result as Result
from bench.scoring.score import score as score
from synth.recording_flow.video_flow import RecordingFlowSettings as Settings

__all__ = ["ForceEstimate", "Method", "MethodContext", "Result", "Settings", "export_recording", "score"]
