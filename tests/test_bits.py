import pytest

from tests.bits import CASES, ESTIMATES, computed, is_here, machine, table

PAIRS = [name for name in CASES if name.startswith("pair")]


@pytest.mark.parametrize("name", PAIRS)
def test_a_final_map_keeps_its_bits(name):
    rows = table()
    if rows["machine"] != machine():
        pytest.skip(f"the table was made with {rows['machine']}, this is {machine()}")
    now = computed(name)
    assert {field: now[field] for field in ESTIMATES} == {f: rows[name][f] for f in ESTIMATES}


def test_the_table_has_every_case_and_no_other():
    rows = list(table())
    assert rows == ["machine", *(name for name in CASES if name in rows)]
    assert {name for name in CASES if not name.startswith("utias")} <= set(rows)


def test_a_case_whose_data_set_is_absent_is_left_out(monkeypatch, tmp_path):
    monkeypatch.setattr("tests.bits.SETS", tmp_path)
    assert not is_here("utias 6")
    assert is_here("thesis 1")
