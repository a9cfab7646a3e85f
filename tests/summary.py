#!/usr/bin/env python3
"""Adds up test results: summary.py [NAME=ok|failed ...] BUILD_FOLDER...

Reads meson's log of each build folder. A test program that prints cmocka's report counts with its tests, any other as one.
Prints what failed and, last, "N passed, N failed"; exits 1 when something failed or nothing passed.
"""
import json
import os
import re
import sys


def counts(text):
    """(passed, failed, skipped) of a cmocka report; None where there is none."""
    def total(word):
        return sum(int(n) for n in re.findall(r"\[ +" + word + r" +\] (\d+) test\(s\)", text))

    if not re.search(r"\d+ test\(s\) run\.", text):
        return None
    return total("PASSED"), total("FAILED"), total("SKIPPED")


def one(test):
    text = test.get("stdout", "") + test.get("stderr", "")
    report = counts(text)
    good = test["result"] in ("OK", "SKIP", "EXPECTEDFAIL")
    if report is None:
        return (0, 0, 1) if test["result"] == "SKIP" else (int(good), int(not good), 0)
    passed, failed, skipped = report
    if not good and failed == 0:  # a sanitizer's report or a crash behind the last test
        failed = 1
    return passed, failed, skipped


def main():
    passed = failed = skipped = 0
    for argument in sys.argv[1:]:
        if "=" in argument:
            name, result = argument.split("=")
            passed += result == "ok"
            failed += result != "ok"
            if result != "ok":
                print(f"failed: {name}")
            continue
        path = f"{argument}/meson-logs/testlog.json"
        if not os.path.exists(path):
            failed += 1
            print(f"failed: {argument}: no test was run")
            continue
        with open(path, encoding="utf-8") as log:
            for line in log:
                test = json.loads(line)
                p, f, s = one(test)
                passed, failed, skipped = passed + p, failed + f, skipped + s
                if f:
                    print(f"failed: {argument}: {test['name']}")
    if skipped:
        print(f"{skipped} tests were skipped, for want of what they need")
    print(f"{passed} passed, {failed} failed")
    sys.exit(failed > 0 or passed == 0)


main()
