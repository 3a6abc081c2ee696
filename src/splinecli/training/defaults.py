"""Names and intervals of training that the command line shows before it loads PyTorch."""

PRESET_NAMES = ("compact", "refine", "paper", "cnn-ps")
DEFAULT_PRESET = "compact"
DEFAULT_STEPS = 40_000
PAPER_STEPS = 200_000
REFINE_STEPS = 6_000
CHECKPOINT_SECONDS = 45  # the checkpoint and the figures are renewed after this many seconds
REPORT_STEPS = 60  # metrics.csv gets a line after this many steps, and with each checkpoint
CHECKPOINT = "checkpoint.safetensors"
WEIGHTS = "weights.safetensors"
CONFIG = "config.json"
METRICS = "metrics.csv"
EVENTS = "tensorboard"
