from .inference.apply import predict as predict
from .inference.force_estimator import predict_force as predict_force
from .inference.predict import ForceMap as ForceMap
from .inference.predict import Predictor as Predictor
from .inference.predict import load_model as load_model
from .network.registry import Network as Network
from .network.shape import Shape as Shape
