//! What `--help` of `ctl` and its commands says beyond their arguments.

/// Of `ctl` itself.
pub(in super::super) const EXAMPLES: &str = "\
Without a port, ADDRESS is a board's, port 80; on this machine 8480. HOST_SIM_GATEWAY
and HOST_SIM_GATEWAY_KEY stand for --to and --key.

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

The key is read from its file, which must be its owner's alone (mode 0600). It is never
sent, but by `claim`: requests are signed with it. docs/ctl.md goes through all of it.

Exit codes: 0 done, 1 a gateway refused or was not reached, 2 a file or an argument is
wrong and nothing was changed, 3 a gateway or its doctor says that something is wrong.";

pub(super) const CAPTURE: &str = "\
A capture that exists is replaced, no other file. Wireshark opens it; `host-sim export lua`
makes the dissector.

Examples:
  host-sim ctl --to 127.0.0.1 capture cell.pcapng --for 10s
  host-sim ctl --to 192.168.0.20 capture force.pcapng --port force";

pub(super) const BUNDLE: &str = "\
One JSON document: info, status, values, revisions, metrics, findings, log, configuration.
The key is not in it.

Example:
  host-sim ctl --to 192.168.0.20 bundle cell-3.json";

pub(super) const CLAIM: &str = "\
Makes a key, writes it to the file, asks you to press the board's button, and gives the
board the key once it takes one. Nobody else can claim it then. The key goes over the
network this once: do it where nobody listens.

Examples:
  host-sim ctl --to 192.168.0.20 claim cell-3.key
  host-sim ctl --to 192.168.0.20 --key cell-3.key status";

pub(super) const CONFIRM: &str = "\
Examples:
  host-sim ctl --to 192.168.0.20 confirm
  host-sim ctl --inventory cells.toml confirm --batch 4 --stop-on-failure";

pub(super) const STATUS: &str = "\
Health is `running`, `port-silent`, `no-controller` or `idle`; all but the first make the
exit code 3.

Examples:
  host-sim ctl --to 127.0.0.1 status
  host-sim ctl --to 127.0.0.1 status --watch
  host-sim ctl --to 127.0.0.1 status --json | jq .ports";

pub(super) const VALUES: &str = "\
Examples:
  host-sim ctl --to 127.0.0.1 values
  host-sim ctl --to 127.0.0.1 values WordInputReg DigitalOut --watch";

pub(super) const TRACE: &str = "\
Seconds, port, direction, and the values of the frame; of what is rejected the reason and
the bytes, as `host-sim decode` takes them.

Examples:
  host-sim ctl --to 127.0.0.1 trace
  host-sim ctl --to 127.0.0.1 trace rs485-1 --json
  host-sim ctl --to 192.168.0.20 trace force --file cell.toml";

pub(super) const DOCTOR: &str = "\
The findings are those of docs/trouble.md. A host's gateway has them ready; a board is
listened to for some seconds. A note alone counts as nothing found.

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
The file is checked before anything is sent: a mistake has its place, and exit code 2.
A host gets its text, a board the image that is made of it. A board takes an image too, such
as `config -o` writes one. controller.address on the own machine is refused for a board,
unless --set says it.

Examples:
  host-sim ctl --to 192.168.0.20 push cell.toml
  host-sim ctl --to 192.168.0.20 push cell.toml --apply --confirm-s 120
  host-sim ctl --to 192.168.0.20 push cell.toml --set controller.address=192.168.0.9
  host-sim ctl --to 192.168.0.20 push older.img
  host-sim ctl --to 192.168.0.20 confirm";

pub(super) const APPLY: &str = "\
The safe values go out, the gateway ends, and another one starts with the revision. Unless
somebody confirms it in time, the one before comes back.

Examples:
  host-sim ctl --to 192.168.0.20 apply
  host-sim ctl --to 192.168.0.20 apply --revision 3 --confirm-s 300";

pub(super) const ROLLBACK: &str = "\
The live revision runs again. Without a trial, as when it has just ended by itself, this is
refused with what is live; --previous then goes back one revision, without a trial.

Examples:
  host-sim ctl --to 192.168.0.20 rollback
  host-sim ctl --to 192.168.0.20 apply --revision 3      an older one, on trial
  host-sim ctl --to 192.168.0.20 rollback --previous     the one before, at once";

pub(super) const UPDATE: &str = "\
The file is checked first: for this board, its free slot, and the key of its loader. Sending
changes nothing of what runs, and the same command goes on where a lost one ended. A trial
stops the cell: the safe values go out, and the board restarts. On trial it confirms itself
once as many links and ports work as before; if not, it takes itself back.

Examples:
  host-sim ctl --to 192.168.0.20 update                              what runs
  host-sim ctl --to 192.168.0.20 update firmware-0.3.0.rgu           sent and checked
  host-sim ctl --to 192.168.0.20 update firmware-0.3.0.rgu --try --confirm
  host-sim ctl --to 192.168.0.20 update --back
  host-sim ctl --inventory plant.toml update firmware-0.3.0.rgu --batch 10 --stop-on-failure

With --inventory each board is sent the file, tries it, and is confirmed once it does as
well as before for 10 s; one that does not is taken back. Boards that run this version are left
alone, so the same command goes on where one has ended. Ctrl-C waits for the boards in hand.

Exit code 1 if one of the boards does not run it, 2 if the file is wrong, 3 if the
board does worse than before.";

pub(super) const EDGE: &str = "\
The file is that of `host-sim gateway --sparkplug`, with plain = true: a board speaks no TLS.
Whoever listens on the way reads the password. The board keeps it, never shows it, and tells
from its next start on; --restart starts it at once, after the safe values went out.

Examples:
  host-sim ctl --to 192.168.0.20 edge sparkplug.toml --restart
  host-sim ctl --to 192.168.0.20 edge
  host-sim ctl --to 192.168.0.20 edge --off --restart
  host-sim ctl --inventory cells.toml edge               all of them

Exit code 2 if the file is wrong, 3 if the node has no session.";

pub(super) const KEYGEN: &str = "\
The key of a gateway on a host: the file belongs on its machine and on yours. With
--signing, a key for updates of boards: FILE stays where firmware is signed, and FILE.pub
is built into the loader of the boards.

Examples:
  host-sim ctl keygen console.key
  host-sim gateway -c cell.toml --console 127.0.0.1:8480 --console-key console.key
  host-sim ctl keygen --signing firmware.key
  RECIPE_UPDATE_KEY=$PWD/firmware.key.pub cargo loader";

pub(super) const SIGN: &str = "\
One firmware, linked once for each slot of a board. A board takes the one for the slot
that it does not run from, and its loader runs it if it was signed with the right key.

Examples:
  host-sim ctl sign --signing-key firmware.key --board nucleo-h743zi --version 0.3.0 \\
      --slot-a slot-a.elf --slot-b slot-b.elf -o firmware-0.3.0.rgu
  host-sim ctl inspect firmware-0.3.0.rgu --public-key firmware.key.pub";

pub(super) const INSPECT: &str = "\
Without a public key nothing is said of the signature. A board that has no firmware yet
gets it from a probe, for either slot.

Examples:
  host-sim ctl inspect firmware-0.3.0.rgu --public-key firmware.key.pub
  host-sim ctl inspect firmware-0.3.0.rgu --slot a -o slot-a.bin
  probe-rs download --chip STM32H743ZITx --binary-format bin \\
      --base-address 0x08020000 slot-a.bin

Exit code 3 if it is damaged, or signed with another key.";
