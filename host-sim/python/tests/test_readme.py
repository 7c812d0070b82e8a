"""The examples of README.md, as they stand there."""

import importlib.metadata
import re
import subprocess
import sys

import duco_sim


def blocks():
    """The blocks of Python in the installed package's description, which is README.md."""
    text = importlib.metadata.metadata("duco-sim").get_payload()
    found = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    assert len(found) == 4, "an example was added or is not found"
    return found


def test_the_five_minutes(tmp_path):
    named = [(match[1], block) for block in blocks() if (match := re.match(r"# (\w+\.py)\n", block))]
    assert [name for name, _ in named] == ["cell.py", "test_cell.py"]
    for name, block in named:
        (tmp_path / name).write_text(block)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--strict-markers", "test_cell.py"]
    ran = subprocess.run(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    print(ran.stdout)
    assert ran.returncode == 0
    assert "6 passed" in ran.stdout


def test_the_device():
    (block,) = [block for block in blocks() if "@robot.device" in block]
    exec(compile(block, "README.md", "exec"), {"duco_sim": duco_sim})
