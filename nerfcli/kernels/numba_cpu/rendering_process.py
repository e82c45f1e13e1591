"""The child process that compiles the CPU kernels that render, while its parent compiles those of a training step."""

from nerfcli.child import take_stdout
from nerfcli.kernels.numba_cpu.compile_all import run_rendering

if __name__ == "__main__":
    take_stdout()
    run_rendering()
