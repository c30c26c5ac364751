#!/usr/bin/env python3
"""Prints visod's odometry: `python3 listen.py [--json] [--count N] [--timeout S]`."""

import argparse
import dataclasses
import json
import sys

from visod_client import MessageError, OdometrySubscriber, ServiceError


def main() -> int:
    parser = argparse.ArgumentParser(description="Print visod's odometry as it is published.")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.add_argument("--count", type=int, help="end after this many messages")
    parser.add_argument("--timeout", type=float, help="fail after this many seconds without one")
    parser.add_argument("--service-root", help="the publisher's publish.root")
    parser.add_argument("--service-prefix", help="the publisher's publish.prefix")
    args = parser.parse_args()

    with OdometrySubscriber(args.service_root, args.service_prefix) as odometry:
        printed = 0
        while args.count is None or printed < args.count:
            estimate = odometry.wait(args.timeout)
            if estimate is None:
                print(f"listen.py: no odometry for {args.timeout} s", file=sys.stderr)
                return 1
            if args.json:
                print(json.dumps(dataclasses.asdict(estimate), default=lambda a: a.tolist()), flush=True)
            else:
                print(describe(estimate), flush=True)
            printed += 1
    return 0


def describe(estimate) -> str:
    axes = zip("xyz", estimate.position_m, estimate.sigma_m)
    position = "  ".join(f"{axis} {value:+.3f} ±{sigma:.3f}" for axis, value, sigma in axes)
    return f"{estimate.sequence:>6} {estimate.status:<12} {position} m"


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (MessageError, ServiceError) as e:
        sys.exit(f"listen.py: {e}")
    except KeyboardInterrupt:
        sys.exit(0)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(0)
