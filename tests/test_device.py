"""The device layer: choosing, sources, kernels, memory, drivers."""

import ctypes
import gc
import os
import subprocess
import sys
import threading

import numpy as np
import pyopencl as cl
import pytest

from clsurf.device import Profile, all_devices, choose_device, icd, open_device, pocl_target, sources
from clsurf.device.arrays import HUGE, HostPool, _size_class
from clsurf.device.context import Device
from clsurf.device.doctor import check, examine
from clsurf.device.sources import number_of
from clsurf.errors import DeviceError, DeviceMemoryError, KernelBuildError


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """Return a folder of kernel sources of the test's own."""
    folder = tmp_path / "kernels with a space"
    (folder / "common").mkdir(parents=True)
    monkeypatch.setattr(sources, "kernel_folder", lambda: folder)
    return folder


def test_self_test(device):
    check(device)  # raises where the device answers wrongly


def test_the_same_choice_opens_once(device):
    assert open_device(device) is device
    kept = open_device(device.cl_device)  # another one where a test before has made the driver fail
    assert open_device(device.cl_device) is kept
    assert open_device(device.context).context is device.context
    assert open_device(device.queue).queue is device.queue


@pytest.mark.parametrize("selector", ["no such device", "gpu:x", "cpu:99"])
def test_unknown_device_names_what_there_is(selector):
    with pytest.raises(DeviceError, match="found: "):
        choose_device(selector)


def test_wrong_device_type():
    with pytest.raises(DeviceError, match="got int"):
        open_device(3)


def test_selectors(device):
    assert choose_device("cpu").type & cl.device_type.CPU
    assert "Portable" in choose_device("pocl").platform.name
    assert choose_device(device.name[:8])
    assert choose_device("CPU:0") == choose_device("cpu")
    ranks = ["gpu" if d.type & cl.device_type.GPU else d.platform.name.lower() for d in all_devices()]
    if any("intel" in r for r in ranks) and any("portable" in r for r in ranks):
        assert next(r for r in ranks if r != "gpu").startswith("intel")  # the faster runtime is the default


def test_environment_chooses(monkeypatch):
    monkeypatch.setenv("CLSURF_DEVICE", "pocl")
    assert "Portable" in open_device().platform_name


def test_includes_expand_once_with_line_marks(kernels):
    (kernels / "common" / "a.clh").write_text("int a;\n")
    (kernels / "b.clh").write_text('#include "common/a.clh"\nint b;\n')
    (kernels / "k.cl").write_text('// first\n#include "common/a.clh"\n#include "b.clh"\nint c;\n')
    text = sources.kernel_text("k.cl", {"N": 3, "R": 0.5, "ON": True, "BIG": np.inf})
    assert text.count("int a;") == 1
    assert text.splitlines()[:4] == ["#define BIG INFINITY", "#define N 3", "#define ON 1", "#define R 0.5f"]
    at = text.splitlines().index("int c;")
    assert text.splitlines()[at - 1] == '#line 4 "k.cl"'


def test_missing_source(kernels):
    with pytest.raises(DeviceError, match="gone"):
        sources.expanded("gone.cl")


def test_argument_dtypes():
    text = """__kernel /* c */ __attribute__((reqd_work_group_size(1, 1, 1))) void k(__global const float *a, // x
              const int n, float4 v, __local int *l, ulong m) {}"""
    dtypes = sources.argument_dtypes(text, "k")
    assert dtypes[0] is None and dtypes[3] is None
    assert dtypes[1] == np.int32 and dtypes[4] == np.uint64 and np.dtype(dtypes[2]).itemsize == 16
    with pytest.raises(DeviceError, match="not found"):
        sources.argument_dtypes(text, "other")


def test_build_error_names_file_and_line(device, kernels):
    (kernels / "bad.cl").write_text("// fine\n__kernel void bad(__global int *a) {\n  a[0] = oops;\n}\n")
    with pytest.raises(KernelBuildError, match=r"oops") as caught:
        device.kernel("bad.cl")
    assert "bad.cl" in str(caught.value) and "3" in str(caught.value)


def test_kernels_are_kept_per_thread(device):
    first = device.kernel("common/self_test.cl", constants={"VW": 16})
    assert device.kernel("common/self_test.cl", constants={"VW": 16}) is first
    assert device.kernel("common/self_test.cl", constants={"VW": 4}) is not first
    other = []
    thread = threading.Thread(target=lambda: other.append(device.kernel("common/self_test.cl", constants={"VW": 16})))
    thread.start()
    thread.join()
    assert other[0] is not first


@pytest.mark.parametrize("count", (29, 64, 5))
def test_items_asked_for_one_by_one_run_in_groups(device, count, monkeypatch):
    """Every one of them, and none that was not asked for."""
    monkeypatch.setattr(device, "group_items", 8)
    sizes, enqueue = [], cl.enqueue_nd_range_kernel
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", lambda *given: (sizes.append(given[3]), enqueue(*given)))
    source, target = device.upload(np.arange(64, dtype=np.float32)), device.empty(64, np.float32)
    device.fill(target, -1)
    device.kernel("common/self_test.cl", constants={"VW": 1})((count,), (1,), source, target, 2.0)
    got = device.download(target)
    np.testing.assert_allclose(got[:count], 2 * np.sqrt(np.arange(count)) + 1, rtol=1e-6)
    assert (got[count:] == -1).all() and ((8,) in sizes) == (count >= 8 or device.loop_turns is not None)


def test_drivers_that_end_long_loops(device):
    """Groups are filled up, with items that do nothing; a loop that was cut off is an error at the download."""
    other = Device(device.cl_device)
    other.loop_turns, other.ended, other.group_items = 65535, other.upload(np.zeros(2, np.int32)), 8
    given, target = np.arange(64, dtype=np.float32), other.upload(np.full(64, -1, np.float32))
    whole, part = device.empty(64, np.float32), other.kernel("common/self_test.cl", constants={"VW": 1})
    device.kernel("common/self_test.cl", constants={"VW": 1})((64,), (1,), device.upload(given), whole, 2.0)
    part((61,), (1,), other.upload(given), target, 2.0)
    assert (other.download(target) == np.append(device.download(whole)[:61], 3 * [-1.0])).all()
    other.write(other.ended, np.array([0, number_of("self_test")], np.int32))
    with pytest.raises(DeviceError, match="ends loops after 65,535 turns, too few for self_test"):
        other.download(target)
    assert (other.download(target)[61:] == -1).all()


@pytest.mark.parametrize("lanes", [16, 8, 4, 1])
def test_lane_helpers(device, lanes):
    """Every macro of lanes.clh against NumPy, in every form."""
    rng = np.random.default_rng(lanes)
    a, b = rng.normal(size=(2, 64)).astype(np.float32)
    kernel = device.kernel("common/probe_lanes.cl", constants={"VW": lanes})
    outputs = [device.empty(64, np.float32) for _ in range(4)]
    flags = device.empty((64 // lanes, 2), np.int32)
    kernel((64 // lanes,), (1,), device.upload(a), device.upload(b), *outputs, flags)
    low, high, root, chosen = map(device.download, outputs)
    np.testing.assert_array_equal(low, np.minimum(a, b))
    np.testing.assert_array_equal(high, np.maximum(a, b))
    np.testing.assert_allclose(root, np.sqrt(a * a), rtol=1e-6)
    np.testing.assert_array_equal(chosen, np.where(a > b, a, 7).astype(np.int32))
    groups = (a > b).reshape(-1, lanes)
    got = device.download(flags) != 0
    np.testing.assert_array_equal(got, np.stack([groups.any(axis=1), groups.all(axis=1)], axis=1))


def test_frame_of_normal(device):
    """The kernels' frame is the data type's frame, poles included, and right-handed."""
    from clsurf.surface.slim import frame_of_normals
    n = np.random.default_rng(0).normal(size=(61, 3))
    n = np.concatenate([n, [[0, 0, 1], [0, 0, -1], [1e-4, 0, -1]]])
    n = (n / np.linalg.norm(n, axis=1, keepdims=True)).astype(np.float32)
    out = device.empty((64, 6), np.float32)
    device.kernel("common/probe_frame.cl")((64,), None, device.upload(n), out)
    u, v = np.split(device.download(out), 2, axis=1)
    wanted_u, wanted_v = frame_of_normals(n.astype(np.float64))
    np.testing.assert_allclose(u, wanted_u, atol=2e-4)
    np.testing.assert_allclose(v, wanted_v, atol=2e-4)
    np.testing.assert_allclose(np.cross(wanted_u, wanted_v), n, atol=1e-6)


def test_wrong_number_of_arguments(device):
    with pytest.raises(TypeError, match="expected 3 arguments, got 1"):
        device.kernel("common/self_test.cl", constants={"VW": 16})((1,), None, 1)


def test_launch_of_nothing(device):
    array = device.zeros(16, np.float32)
    device.kernel("common/self_test.cl", constants={"VW": 16})((0,), None, array, array, 1.0)
    assert not device.download(array).any()


@pytest.mark.parametrize("shape", [(0,), (1,), (1000, 3), (1 << 20,)])
def test_arrays_round_trip(device, shape):
    values = np.random.default_rng(1).integers(0, 99, shape).astype(np.int32)
    np.testing.assert_array_equal(device.download(device.upload(values)), values)
    strided = np.asfortranarray(values)
    np.testing.assert_array_equal(device.download(device.upload(strided)), values)
    assert not device.download(device.zeros(shape, np.float32)).any()


def test_memory_is_refused_before_it_is_taken(device):
    with pytest.raises(DeviceMemoryError, match="lists alone 9000000"):
        device.check_memory(lists=9e15, records=100)
    device.check_memory(records=1000)
    device.check_memory()


def test_pool_reuses_blocks_only_when_no_array_lives():
    pool = HostPool()
    first = pool.take(3 * HUGE)
    address = first.ctypes.data
    view = first[10:].view()
    del first
    gc.collect()
    assert pool.kept_bytes == 0  # a view still uses it
    assert pool.take(3 * HUGE).ctypes.data != address
    del view
    gc.collect()
    assert pool.kept_bytes >= 3 * HUGE
    pool.trim()
    assert pool.kept_bytes == 0


@pytest.mark.parametrize("nbytes", [1, 4096, 4097, 10 ** 6, 12345678])
def test_size_classes_waste_little(nbytes):
    size = _size_class(nbytes)
    assert size >= nbytes and size % 4096 == 0 and size <= max(4096, nbytes) * 1.125 + 4096


def test_profile_counts_launches(device):
    array = device.zeros(64, np.float32)
    device.profile = Profile()
    try:
        for _ in range(3):
            device.kernel("common/self_test.cl", constants={"VW": 16})((4,), (1,), array, array, 1.0)
        (label, calls, low, median, share), = device.profile.rows()
    finally:
        device.profile = None
    assert (label, calls, share) == ("self_test", 3, 1.0) and 0 < low <= median


def test_dump(device, tmp_path, monkeypatch):
    monkeypatch.setenv("CLSURF_DUMP", str(tmp_path))
    device.kernel("common/self_test.cl", constants={"VW": 16, "UNIQUE": 12345})
    text, = (path.read_text() for path in tmp_path.glob("self_test-*.cl"))
    assert "#define UNIQUE 12345" in text


def test_processor_names():
    avx512 = {"avx512f", "avx512bw", "avx512dq", "avx512vl", "avx512cd"}
    avx2 = {"avx2", "fma", "bmi1", "bmi2", "f16c"}
    assert pocl_target.target_name(avx512 | avx2) == "skylake-avx512"
    assert pocl_target.target_name(avx2) == "haswell"
    assert pocl_target.target_name(set()) == "x86-64"


def test_pocl_target_takes_the_first_of_several_pointers():
    # The record's neighbours on the heap point to the same text in about one process of thirty.
    text = ctypes.create_string_buffer(b"generic")
    record = (ctypes.c_uint64 * 512)()
    fd = os.open("/proc/self/mem", os.O_RDONLY)
    try:
        assert pocl_target.first_pointer_to_generic(fd, ctypes.addressof(record)) is None
        record[80] = record[90] = ctypes.addressof(text)
        assert pocl_target.first_pointer_to_generic(fd, ctypes.addressof(record)) == 640
    finally:
        os.close(fd)


def test_vendors_folder_is_made_and_a_users_own_respected(tmp_path):
    """In a fresh process each: the module acts once."""
    code = "import os; from clsurf.device import icd; icd.prepare(); print(os.environ.get('OCL_ICD_VENDORS', ''))"
    run = lambda env: subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,  # noqa: E731
                                     env=env).stdout.strip()
    env = {k: v for k, v in os.environ.items() if k != "OCL_ICD_VENDORS"} | {"XDG_CACHE_HOME": str(tmp_path)}
    made = run(env)
    if icd.wanted_entries():
        assert made.startswith(str(tmp_path))
    else:
        assert made == ""
    assert run(env | {"OCL_ICD_VENDORS": "/mine"}) == "/mine"


def test_importing_makes_no_context():
    code = "import clsurf, pyopencl as cl, gc; print(any(isinstance(o, cl.Context) for o in gc.get_objects()))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "False"


def test_doctor_finds_this_machine_healthy():
    findings = examine()
    assert all(f.good for f in findings), [f for f in findings if not f.good]
    assert sum("compiles and computes" in f.detail for f in findings) == len(all_devices())


def test_a_device_is_named_once(device, caplog):
    """A second device object on the same record, through a context of the user's own, leaves the record alone."""
    mine = cl.Context([device.cl_device])
    check(open_device(mine))
    first = pocl_target.name_processor(device.cl_device)
    assert pocl_target.name_processor(device.cl_device) == first
    assert "not found" not in caplog.text
