"""The walker of benchmarks and corpus: people who differ and vary, any motion from any view, errors of detectors."""
