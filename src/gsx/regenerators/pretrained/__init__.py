"""Pretrained networks in files: ncnn's and ONNX, run by a process of their own."""
