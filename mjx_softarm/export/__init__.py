"""The policy beyond Python: one ONNX graph, one C++ header, and golden rows that check any of them."""
