"""Klipper itself in batch mode, with what it says and where it sends the tool head on stdout.

Run in Klipper's own environment: `python klippy_child.py KLIPPER FOLDER SHARE`; FOLDER holds
printer.cfg and job.gcode. In batch mode no pin triggers: Klipper takes a probing move to have
triggered at its end. So each is told to have triggered at a share of its way; 0: it met nothing.
"""

from __future__ import annotations

import os
import runpy
import sys

PROBE_PIN = "13"  # the axes' own end stops answer as they do
source, folder, share = sys.argv[1], sys.argv[2], float(sys.argv[3])
sys.path.insert(0, source + "/klippy")

import mcu  # noqa: E402
import toolhead  # noqa: E402

import gcode  # noqa: E402  (Klipper's)

respond, go_wrong = gcode.GCodeDispatch.respond_raw, gcode.GCodeDispatch._respond_error
move = toolhead.ToolHead.move
begin, wait = mcu.MCU_endstop.home_start, mcu.MCU_endstop.home_wait


class ByLine:
    """As a host sends: a line comes once the last one is done, and what is due comes between."""

    def __getattr__(self, name):
        return getattr(os, name)

    def read(self, fd, most):
        data = os.read(fd, 1)
        while data and data[-1:] != b"\n" and (more := os.read(fd, 1)):
            data += more
        return data


def say(self, text):
    print("SAID", text.replace("\n", "\nSAID "), flush=True)
    respond(self, text)


def after_an_error(self, text):
    self.is_fileinput = False  # a printer goes on
    go_wrong(self, text)
    self.is_fileinput = True


def told(self, place, speed):
    print("MOVE", *(f"{value:.5f}" for value in place[:4]))
    return move(self, place, speed)


def home_start(self, print_time, *given, **named):
    self.begun = print_time
    return begin(self, print_time, *given, **named)


def home_wait(self, end):
    wait(self, end)
    if PROBE_PIN not in str(self._pin):
        return end
    return self.begun + (end - self.begun) * share if share else 0.0


gcode.os = ByLine()
gcode.GCodeDispatch.respond_raw = say
gcode.GCodeDispatch._respond_error = after_an_error
toolhead.ToolHead.move = told
mcu.MCU_endstop.home_start, mcu.MCU_endstop.home_wait = home_start, home_wait
sys.argv = [
    source + "/klippy/klippy.py", folder + "/printer.cfg", "-i", folder + "/job.gcode",
    "-o", folder + "/out", "-d", source + "/out/klipper.dict", "-l", folder + "/log",
]  # fmt: skip
runpy.run_path(sys.argv[0], run_name="__main__")
