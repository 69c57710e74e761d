from learn.inference.force_reader import predict_force as predict_force
from learn.inference.predict import ForceMap as ForceMap
from learn.inference.predict import Predictor as Predictor
from learn.inference.predict import load_model as load_model
