from workers.store.mounts import file_system_of


def test_the_file_system_of_a_folder_is_what_the_kernel_says():
    assert file_system_of("/proc/self") == "proc"
    assert file_system_of("/sys/kernel") == "sysfs"
