//! What `--help` of `ctl` and its commands says beyond their arguments.

/// Of `ctl` itself.
pub(in super::super) const EXAMPLES: &str = "\
Examples:
  host-sim ctl --to 127.0.0.1:8480 status
  host-sim ctl --to 192.168.0.20 claim cell-3.key       a board's first key
  export HOST_SIM_GATEWAY=192.168.0.20 HOST_SIM_GATEWAY_KEY=cell-3.key
  host-sim ctl status --watch
  host-sim ctl values force --watch
  host-sim ctl push cell.toml --apply --confirm-s 60
  host-sim ctl confirm
  host-sim ctl revisions --json
  host-sim ctl --inventory cells.toml status            many gateways at once

Only `claim` sends the key; otherwise it signs requests. docs/ctl.md is a tutorial.

Exit codes: 0 done, 1 a gateway refused or was not reached, 2 a file or an argument is
invalid and nothing was changed, 3 a gateway or its doctor reports a problem.";

pub(super) const CAPTURE: &str = "\
An existing FILE is replaced only if it is a capture. `host-sim export lua` makes a
dissector for Wireshark.

Examples:
  host-sim ctl --to 127.0.0.1 capture cell.pcapng --for 10s
  host-sim ctl --to 192.168.0.20 capture force.pcapng --port force";

pub(super) const BUNDLE: &str = "\
Contains info, status, values, revisions, metrics, findings, log and configuration, but
not the key.

Example:
  host-sim ctl --to 192.168.0.20 bundle cell-3.json";

pub(super) const CLAIM: &str = "\
Generates a key, writes it to the file, asks you to press the board's button, and sends
the board the key. Nobody else can claim it then. The key goes over the network this
once, unencrypted: do it where nobody listens.

Examples:
  host-sim ctl --to 192.168.0.20 claim cell-3.key
  host-sim ctl --to 192.168.0.20 --key cell-3.key status";

pub(super) const CONFIRM: &str = "\
Examples:
  host-sim ctl --to 192.168.0.20 confirm
  host-sim ctl --inventory cells.toml confirm --batch 4 --stop-on-failure";

pub(super) const STATUS: &str = "\
Health is `running`, `port-silent`, `no-controller` or `idle`; all but `running` give exit
code 3.

Examples:
  host-sim ctl --to 127.0.0.1 status
  host-sim ctl --to 127.0.0.1 status --watch
  host-sim ctl --to 127.0.0.1 status --json | jq .ports";

pub(super) const VALUES: &str = "\
Examples:
  host-sim ctl --to 127.0.0.1 values
  host-sim ctl --to 127.0.0.1 values WordInputReg DigitalOut --watch";

pub(super) const TRACE: &str = "\
Each line has seconds, port, direction and the values of the frame, or why it was
rejected and its bytes, as `host-sim decode` takes them.

Examples:
  host-sim ctl --to 127.0.0.1 trace
  host-sim ctl --to 127.0.0.1 trace rs485-1 --json
  host-sim ctl --to 192.168.0.20 trace force --file cell.toml";

pub(super) const DOCTOR: &str = "\
docs/trouble.md explains the findings. A host's gateway has them ready; a board is listened
to first. A note alone counts as nothing found.

Examples:
  host-sim ctl --to 127.0.0.1 doctor
  host-sim ctl --to 192.168.0.20 doctor --for 30s --json

Exit code 3 if something is found.";

pub(super) const CONFIG: &str = "\
Examples:
  host-sim ctl --to 127.0.0.1 config > cell.toml
  host-sim ctl --to 127.0.0.1 config --revision 3 -o older.toml
  host-sim ctl --to 192.168.0.20 config -o cell.img      a board has the image";

pub(super) const PUSH: &str = "\
The file is checked before anything is sent; a mistake is shown with its place, and gives
exit code 2. A host gets the text, a board the image made of it, or an image as `config -o`
writes it. For a board, a controller.address on its own machine (such as 127.0.0.1) is
refused unless --set gives it.

Examples:
  host-sim ctl --to 192.168.0.20 push cell.toml
  host-sim ctl --to 192.168.0.20 push cell.toml --apply --confirm-s 120
  host-sim ctl --to 192.168.0.20 push cell.toml --set controller.address=192.168.0.9
  host-sim ctl --to 192.168.0.20 push older.img
  host-sim ctl --to 192.168.0.20 confirm";

pub(super) const APPLY: &str = "\
The gateway sends the safe values, stops, and starts again with the revision. Unless that
is confirmed in time, the revision before comes back.

Examples:
  host-sim ctl --to 192.168.0.20 apply
  host-sim ctl --to 192.168.0.20 apply --revision 3 --confirm-s 300";

pub(super) const ROLLBACK: &str = "\
Without a trial, for example when it has just timed out, it is refused and the message
says what is live; --previous then goes back one revision, without a trial.

Examples:
  host-sim ctl --to 192.168.0.20 rollback
  host-sim ctl --to 192.168.0.20 apply --revision 3      an older revision, on trial
  host-sim ctl --to 192.168.0.20 rollback --previous     the revision before, at once";

pub(super) const UPDATE: &str = "\
The file is checked first: that it fits this board, its free slot, and the key of its loader.
Sending does not affect what runs, and can be resumed with the same command. A trial stops
the cell: the safe values go out, and the board restarts. The new firmware confirms itself
once as many links and ports work as before; if they do not, the board rolls back.

Examples:
  host-sim ctl --to 192.168.0.20 update                              what runs
  host-sim ctl --to 192.168.0.20 update firmware-0.3.0.rgu           sent and checked
  host-sim ctl --to 192.168.0.20 update firmware-0.3.0.rgu --try --confirm
  host-sim ctl --to 192.168.0.20 update --back
  host-sim ctl --inventory plant.toml update firmware-0.3.0.rgu --batch 10 --stop-on-failure

With --inventory each board gets the file, tries it, and is confirmed once it has worked as
well as before for 10 s; otherwise it is rolled back. Boards that run this build already are
left alone, so the same command resumes. Ctrl-C waits for the current boards.

Exit code 1 if one of the boards does not run it, 2 if the file is invalid, 3 if the
board works worse than before.";

pub(super) const EDGE: &str = "\
The file is that of `host-sim gateway --sparkplug`, with plain = true: a board has no TLS, so
the password crosses the network unencrypted. The board keeps it and never shows it. The node
starts with the board's next start; --restart sends the safe values and restarts it now.

Examples:
  host-sim ctl --to 192.168.0.20 edge sparkplug.toml --restart
  host-sim ctl --to 192.168.0.20 edge
  host-sim ctl --to 192.168.0.20 edge --off --restart
  host-sim ctl --inventory cells.toml edge               the nodes of all boards

Exit code 2 if the file is invalid, 3 if the node has no session.";

pub(super) const KEYGEN: &str = "\
The key is for a gateway on a host: copy the file to its machine and to yours. With
--signing it is for board updates: keep FILE where firmware is signed, and build FILE.pub
into the loader of the boards.

Examples:
  host-sim ctl keygen console.key
  host-sim gateway -c cell.toml --console 127.0.0.1:8480 --console-key console.key
  host-sim ctl keygen --signing firmware.key
  RECIPE_UPDATE_KEY=$PWD/firmware.key.pub cargo loader";

pub(super) const SIGN: &str = "\
An update contains the firmware twice, linked for each slot. A board takes the one for its
free slot, and its loader runs it if it was signed with the right key.

Examples:
  host-sim ctl sign --signing-key firmware.key --board nucleo-h743zi --version 0.3.0 \\
      --slot-a slot-a.elf --slot-b slot-b.elf -o firmware-0.3.0.rgu
  host-sim ctl inspect firmware-0.3.0.rgu --public-key firmware.key.pub";

pub(super) const INSPECT: &str = "\
Without --public-key the signature is not checked. A board without firmware gets its first
one from a probe, in either slot.

Examples:
  host-sim ctl inspect firmware-0.3.0.rgu --public-key firmware.key.pub
  host-sim ctl inspect firmware-0.3.0.rgu --slot a -o slot-a.bin
  probe-rs download --chip STM32H743ZITx --binary-format bin \\
      --base-address 0x08020000 slot-a.bin

Exit code 3 if it is damaged, or signed with another key.";
