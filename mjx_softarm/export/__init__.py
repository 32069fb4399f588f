"""The policy beyond Python: ONNX graphs, a C++ header, and golden rows that check them."""
