"""A stopwatch of processor time."""

import time

from workers.capture.estimate import ProcessorClock


def test_waiting_takes_no_processor_time_and_work_does():
    clock = ProcessorClock()
    with clock.stage("wait"):
        time.sleep(0.2)
    with clock.stage("work"):
        begun = time.process_time()
        while time.process_time() - begun < 0.1:
            pass
    assert clock.seconds["wait"] < 0.1 <= clock.seconds["work"] < 0.3
