from bench.methods.protocol import Answer as Answer
from bench.methods.protocol import Method as Method
from bench.methods.protocol import Scene as Scene
from bench.recording.from_sequence import export_recording as export_recording
from bench.scoring.result import Result as Result
from bench.scoring.score import score as score
