"""simgen: road scenes with a wide-baseline camera rig, rendered with exact ground truth."""

__version__ = "0.1.0"
