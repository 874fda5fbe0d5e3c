"""Hands a job to a Ray cluster from its head, follows its log, and ends with its exit code.

    ray submit deploy/cluster.yaml deploy/submit.py JOB [options of `verso run`]
    ray submit deploy/cluster.yaml deploy/submit.py --follow ID
    ray submit deploy/cluster.yaml deploy/submit.py --stop ID

`ray submit` copies this one file, so it starts what is installed on the head (services/queue/hand_over.py). Ray joins the words
of its command line unquoted into a shell on the head; from here on, no shell sees them as anything but words.
"""

import os
import sys

if __name__ == "__main__":
    os.execv(sys.executable, [sys.executable, "-P", "-m", "services.queue.hand_over", *sys.argv[1:]])
