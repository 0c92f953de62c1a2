//! Other users' files, short shared memory, full disks, limits.

use std::fs;
use std::os::unix::fs::PermissionsExt;

use crate::support::{Scratch, in_private_mounts, shell};

const RUN: &str = "run $REACH --set clock=lockstep --set duration_s=0.1 --no-report --quiet --out";

#[test]
fn short_shared_memory_is_a_sentence_with_the_size_needed() {
    let scratch = Scratch::new("shm");
    for size in ["0k", "64k", "256k", "1m", "2000k", "4m"] {
        // tmpfs takes 0 for no limit.
        let size = if size == "0k" { "4k" } else { size };
        let script = format!(
            "mount -t tmpfs -o size={size} tmpfs /dev/shm && $DELMPC {RUN} {}/out",
            scratch.path().display()
        );
        let Some(ended) = in_private_mounts("short_shared_memory", &script) else { return };
        ended.assert(3, &["/dev/shm has", "KiB are needed"]);
    }
    let script =
        format!("mount -t tmpfs -o size=7m tmpfs /dev/shm && $DELMPC {RUN} {}/out", scratch.path().display());
    if let Some(ended) = in_private_mounts("short_shared_memory", &script) {
        ended.assert(0, &[]);
    }
}

/// A run with room for its shared memory only: somebody else takes what is left.
#[test]
fn shared_memory_that_fills_up_meanwhile_is_no_sigbus() {
    let scratch = Scratch::new("shm-full");
    let script = format!(
        "mount -t tmpfs -o size=10m tmpfs /dev/shm; cd /dev/shm
        (while :; do head -c 4k /dev/zero >> filler 2>/dev/null; truncate -s 0 filler; head -c 3m /dev/zero > filler 2>/dev/null; done) & filler=$!
        for i in 1 2 3 4; do $DELMPC {RUN} {}/out$i; status=$?; [ $status = 0 ] || [ $status = 3 ] || exit $status; done
        kill $filler; exit 0",
        scratch.path().display()
    );
    if let Some(ended) = in_private_mounts("shared_memory_that_fills_up", &script) {
        ended.assert(0, &[]);
        assert!(!ended.errors.contains("signal 7"), "{ended:?}");
    }
}

#[test]
fn a_full_disk_is_a_sentence_and_what_is_whole_can_be_replayed() {
    let scratch = Scratch::new("disk");
    let mount = scratch.file("disk");
    fs::create_dir(&mount).unwrap();
    let script = format!(
        "mount -t tmpfs -o size=1m tmpfs {mount}
        $DELMPC run $REACH --set clock=lockstep --set duration_s=6 --no-report --quiet --out {mount}/o; echo run $?
        rm -f {mount}/o/summary.json; $DELMPC replay {mount}/o --verify; echo replay $?"
    );
    let Some(ended) = in_private_mounts("a_full_disk", &script) else { return };
    assert!(ended.out.contains("run 3") && ended.out.contains("replay 0"), "{ended:?}");
    assert!(ended.errors.contains("No space left") && ended.out.contains("the log is cut"), "{ended:?}");
    assert!(!ended.errors.contains("panicked"), "{ended:?}");
}

/// Another user has put a folder with our old name there, whose contents lead into the files of whoever runs the command.
#[test]
fn what_another_user_leaves_in_tmp_is_neither_followed_nor_waited_for() {
    let scratch = Scratch::new("victim");
    let victim = scratch.write("precious", "1");
    let folder = scratch.path().display();
    let script = format!(
        "mount -t tmpfs -o mode=1777 tmpfs /tmp/.delmpc-test-mount 2>/dev/null
        export TMPDIR={folder}/tmp; mkdir -p $TMPDIR; chmod 1777 $TMPDIR; unset XDG_RUNTIME_DIR
        for name in delmpc_0123456789abcdef delmpc-$(id -u)/0123456789abcdef; do
          mkdir -p -m 700 $TMPDIR/${{name%%/*}}; mkdir -p $TMPDIR/$name/nodes; ln -s {folder} $TMPDIR/$name/services
          mkfifo $TMPDIR/$name/nodes/fifo.details; ln -s {folder} $TMPDIR/$name/nodes/link
          touch -h -d '1 hour ago' $TMPDIR/$name $TMPDIR/$name/*; done
        timeout 60 $DELMPC {RUN} {folder}/out"
    );
    shell(&script).assert(0, &[]);
    assert_eq!(fs::read_to_string(&victim).unwrap(), "1");
    assert!(
        scratch.path().join("tmp/delmpc_0123456789abcdef/nodes/fifo.details").exists(),
        "not ours to remove"
    );
}

#[test]
fn a_private_folder_that_is_not_private_is_refused() {
    let scratch = Scratch::new("squatted");
    let folder = scratch.path().display().to_string();
    // As a user of its own, so that nothing else lies in its way.
    let as_nobody = |script: &str| {
        shell(&format!(
            "command -v setpriv >/dev/null && [ $(id -u) = 0 ] || {{ echo SKIPPED; exit 0; }}
            chmod 1777 {folder}; cp $DELMPC {folder}/delmpc; cp $(dirname $REACH)/* {folder}; chmod -R a+rX {folder}
            export TMPDIR={folder}; unset XDG_RUNTIME_DIR; cd {folder}; ls -d /run/user/65000 2>/dev/null && exit 0
            {script}"
        ))
    };
    let run = format!(
        "setpriv --reuid=65000 --regid=65000 --clear-groups timeout 60 {folder}/delmpc run reach.toml --set clock=lockstep \
         --set duration_s=0.1 --no-report --quiet --out {folder}/o65000; status=$?"
    );
    // Root squats the name in both places: there is none left.
    let squat = |make: &str| {
        format!(
            "rm -rf {folder}/delmpc-65000 /tmp/delmpc-65000; {make}; {run}; rm -rf /tmp/delmpc-65000; exit $status"
        )
    };
    let seen =
        as_nobody(&squat(&format!("mkdir -m 777 {folder}/delmpc-65000; mkdir -m 777 /tmp/delmpc-65000")));
    if seen.out.contains("SKIPPED") {
        eprintln!("SKIPPED a_private_folder_that_is_not_private: needs root and setpriv");
        return;
    }
    seen.assert(3, &["has to be private", "belongs to user 0"]);
    let link = format!(
        "mkdir {folder}/theirs; chmod 777 {folder}/theirs; ln -s {folder}/theirs {folder}/delmpc-65000; ln -s {folder}/theirs /tmp/delmpc-65000"
    );
    as_nobody(&squat(&link)).assert(3, &["has to be private"]);
    assert_eq!(fs::read_dir(scratch.path().join("theirs")).unwrap().count(), 0);
    let mode = fs::metadata(scratch.path()).unwrap().permissions().mode();
    assert_eq!(mode & 0o1777, 0o1777);
}

#[test]
fn limits_of_files_processes_and_sizes_are_a_sentence() {
    let scratch = Scratch::new("limits");
    let out = scratch.file("out");
    for files in [10, 16, 24, 32, 40, 48] {
        let ended = shell(&format!("ulimit -n {files}; $DELMPC {RUN} {out}"));
        assert!(matches!(ended.status, Some(0 | 2 | 3 | 127)), "{files} files: {ended:?}");
        assert!(!ended.errors.contains("panicked"), "{files} files: {ended:?}");
    }
    for blocks in [0, 1, 8, 30, 100, 400] {
        let ended = shell(&format!("ulimit -f {blocks}; $DELMPC {RUN} {out}"));
        assert!(matches!(ended.status, Some(0 | 2 | 3)), "{blocks} blocks: {ended:?}");
        assert!(!ended.errors.contains("panicked"), "{blocks} blocks: {ended:?}");
    }
    for folder in ["", "relative", "/nonexistent", "/dev/null", &format!("/tmp/{}", "x".repeat(240))] {
        shell(&format!("TMPDIR='{folder}' $DELMPC {RUN} {out}")).assert(0, &[]);
    }
}
