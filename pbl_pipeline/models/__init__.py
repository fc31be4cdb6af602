"""Networks: BlazePose (TensorFlow Lite), and ONNX models with a graph and a spec, in a registry, on CPU or CUDA."""

from .devices import asked_device, available_devices, providers_for
from .gpu_address import gpu_visible, gpu_wanted
from .network import Network
from .onnx_model import OnnxModel, check_frozen
from .registry import ModelStatus, add, find, is_registered, registered, remove
from .spec import KINDS, ModelInput, ModelSpec, load_spec, mirror_pairs, model_invalid, parse_spec
from .ssd import SsdLayout, SsdModel, box_iou, suppress
from .tflite import LiteModel
