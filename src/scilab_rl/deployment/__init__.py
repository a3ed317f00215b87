"""Policies that leave: as NumPy arrays and ONNX, for a robot that has no PyTorch."""
