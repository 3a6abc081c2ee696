"""Names and intervals of training that the command line needs before PyTorch is loaded."""

PRESET_NAMES = ("compact", "refine", "paper", "cnn-ps")
DEFAULT_PRESET = "compact"
DEFAULT_STEPS = 40_000
PAPER_STEPS = 200_000
REFINE_STEPS = 6_000
CHECKPOINT_SECONDS = 45  # interval between updates of the checkpoint and the figures
REPORT_STEPS = 60  # metrics.csv gets a line every REPORT_STEPS steps, and with each checkpoint
CHECKPOINT = "checkpoint.safetensors"
WEIGHTS = "weights.safetensors"
CONFIG = "config.json"
METRICS = "metrics.csv"
EVENTS = "tensorboard"
CAPTURES = "captures"
