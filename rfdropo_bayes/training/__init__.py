"""Policies: training with Stable-Baselines3, paired evaluation, export to ONNX with a model card."""
