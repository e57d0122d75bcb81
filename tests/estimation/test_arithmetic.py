import json
import os
import platform
import subprocess
import sys

import pytest

from tests.across import CLASSES
from tests.estimation import arithmetic


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the class is one of x86_64")
def test_a_processor_without_avx_computes_the_same_bits():
    finished = subprocess.run(
        [sys.executable, "-m", "tests.estimation.arithmetic"],
        env={**os.environ, **CLASSES["without AVX"]},
        capture_output=True,
        text=True,
        check=True,
    )
    level, found = json.loads(finished.stdout)
    assert level == "x86-64-v2"
    assert found == arithmetic.digests()
