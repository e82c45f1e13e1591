"""SIGTERM in processes of their own, as nothing else shows how C and C++ code handles it."""

import signal
import subprocess
import sys
import threading
import time

import pytest
from commands import in_python, started
from corner import write_capture

from nerfcli.errors import INTERRUPTED, TERMINATED
from nerfcli.poses.input.job import repeatedly
from nerfcli.poses.workspace import workspace


def test_pycolmap_leaves_sigterm_alone_and_keeps_its_traces_of_crashes():
    """The handlers of a C++ library answer only real signals, so they are tested in a process of their own."""
    imported = "import os, signal; import nerfcli.cameras.camera; os.kill(os.getpid(), signal.{}); signal.pause()"
    terminated = in_python(imported.format("SIGTERM"))
    assert (terminated.returncode, terminated.stderr) == (-signal.SIGTERM, "")
    crashed = in_python(imported.format("SIGSEGV"))
    assert crashed.returncode == -signal.SIGSEGV
    assert "SIGSEGV" in crashed.stderr


def test_a_process_that_ignores_sigterm_goes_on_doing_so():
    program = (
        "import os, signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "from nerfcli.interrupts import install_handlers; install_handlers()\n"
        "import nerfcli.cameras.camera; os.kill(os.getpid(), signal.SIGTERM); print('alive')"
    )
    assert in_python(program).stdout == "alive\n"


def test_an_interrupt_that_python_drops_in_a_callback_of_c_comes_again():
    """While numba compiles, LLVM calls back into Python; there a KeyboardInterrupt becomes a message on stderr."""
    program = """
import ctypes, os, signal, time
from nerfcli.interrupts import Terminated, install_handlers

install_handlers()

@ctypes.CFUNCTYPE(None)
def callback():
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.01)

try:
    callback()
    time.sleep(30)
except Terminated:
    print("heard")
"""
    done = in_python(program)
    assert (done.stdout, done.stderr) == ("heard\n", "")


def test_two_interrupts_while_threads_are_in_cpp_code_end_a_command_in_one_line():
    """The second one comes while the pool waits for its threads; Python then ends without them."""
    program = """
import signal, sys
from concurrent.futures import ThreadPoolExecutor
import cv2, numpy as np
from nerfcli import cli
from nerfcli.cli.console import command

def blur(number):
    print("at work", flush=True)
    for _ in range(400):
        cv2.GaussianBlur(np.zeros((400, 400), np.uint8), (31, 31), 5)

@cli.app.command()
@command
def work():
    with ThreadPoolExecutor(1) as pool:
        list(pool.map(blur, [0]))

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in background suites
sys.argv = ["nerfcli", "work"]
cli.main()
"""
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "at work\n"
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.02)
    _, stderr = process.communicate(timeout=60)
    assert (process.returncode, stderr) == (INTERRUPTED, "Interrupted; completed work is kept.\n")


def test_an_interrupt_while_a_watching_thread_starts_leaves_none_that_python_waits_for(monkeypatch: pytest.MonkeyPatch):
    start = threading.Thread.start

    def interrupted(thread: threading.Thread) -> None:
        start(thread)
        raise KeyboardInterrupt

    before = set(threading.enumerate())
    monkeypatch.setattr(threading.Thread, "start", interrupted)
    with pytest.raises(KeyboardInterrupt), repeatedly(lambda: None, seconds=0.01):
        pass
    assert set(threading.enumerate()) <= before


def test_sigterm_ends_poses_and_its_worker_without_a_stack_trace(tmp_path):
    photos, scene = tmp_path / "photos", tmp_path / "scene"
    write_capture(photos)
    process = started("poses", photos, "-o", scene, "--threads", "1", "--quiet")
    deadline = time.monotonic() + 60
    while not list(tmp_path.rglob("database.db")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    stdout, stderr = process.communicate(timeout=60)
    assert (process.returncode, stdout) == (TERMINATED, "")
    assert stderr.splitlines()[-1] == "Ended by SIGTERM; completed work is kept."
    assert not any(word in stderr for word in ("Traceback", "stack trace"))
    assert not (scene / "scene.json").exists()
    with workspace(scene):  # the worker holds its lock as long as it lives
        pass
