"""How onnxruntime is asked to run a network: so many threads, on the GPU where there is one."""

from __future__ import annotations

from pathlib import Path

import onnxruntime


def open_session(network: Path | bytes, device: str, threads: int) -> onnxruntime.InferenceSession:
    """A session of a file or of its bytes, on `device` ("cuda" or "cpu"); onnxruntime's own errors pass through.

    Threads do not spin while they wait, as several networks share the cores; warnings about a model's form are kept
    from the user.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = max(1, threads)
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    wanted = ["CUDAExecutionProvider"] if device == "cuda" else []
    providers = [p for p in [*wanted, "CPUExecutionProvider"] if p in onnxruntime.get_available_providers()]
    source = network if isinstance(network, bytes) else str(network)
    return onnxruntime.InferenceSession(source, options, providers=providers)
