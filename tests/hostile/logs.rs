//! Logs that are damaged or were made to do harm.

use std::fs;
use std::process::Command;

use crate::support::{PROGRAM, Scratch, delmpc, finish, lamp, run};

const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";

/// A record with a length of its own.
fn record(code: u8, length: u64, content: &[u8]) -> Vec<u8> {
    [&[code][..], &length.to_le_bytes(), content].concat()
}

/// A chunk that says of itself what it is told to.
fn chunk(compression: &str, uncompressed: u64, records: &[u8]) -> Vec<u8> {
    let mut content = [0; 16].to_vec();
    content.extend(uncompressed.to_le_bytes());
    content.extend([0; 4]);
    content.extend((compression.len() as u32).to_le_bytes());
    content.extend(compression.as_bytes());
    content.extend((records.len() as u64).to_le_bytes());
    content.extend(records);
    record(6, content.len() as u64, &content)
}

#[test]
fn a_log_of_any_content_is_an_error_within_64_mb() {
    let scratch = Scratch::new("logs");
    run(&scratch, &lamp("reach.toml"), &[]).assert(0, &[]);
    let (out, log) = (scratch.file("out"), scratch.file("out/log.mcap"));
    let whole = fs::read(&log).unwrap();
    let header = record(1, 8, &[0; 8]);
    let inner = record(5, u64::MAX, &[b'x'; 51]);
    let bad: Vec<(&str, Vec<u8>)> = vec![
        ("nothing", Vec::new()),
        ("half a magic", MAGIC[..4].to_vec()),
        ("only a magic", MAGIC.to_vec()),
        ("a record of 2^64 - 1 bytes", record(3, u64::MAX, b"xxxxxxxx")),
        ("a record of 2^63 bytes", record(5, 1 << 63, b"xxxxxxxx")),
        ("a record of 7 GB", record(9, 7 << 30, b"xxxxxxxx")),
        ("a long record in a chunk", chunk("", inner.len() as u64, &inner)),
        ("a chunk that says 7.9e18 bytes", chunk("lz4", 7_900_000_000_000_000_000, b"\x04\x22\x4d\x18")),
        ("a chunk of another compression", chunk("zstd", 100, b"xxxx")),
        ("a chunk of no compression", chunk("nonsense", 100, b"xxxx")),
        ("a message without a channel", record(5, 22, &[0; 22])),
        ("zeros", vec![0; 100_000]),
    ];
    for (what, content) in bad {
        let prefix = if content.len() < 9 { &[][..] } else { &[&MAGIC[..], &header].concat() };
        fs::write(&log, [prefix, &content].concat()).unwrap();
        for arguments in [&["replay", &out, "--verify"][..], &["report", &out]] {
            // As much address space as the program itself takes, and 64 MB.
            let mut command = Command::new("bash");
            command.args(["-c", "ulimit -v 300000; exec \"$0\" \"$@\"", PROGRAM]).args(arguments);
            let ended = finish(command);
            assert_eq!(ended.status, Some(2), "{what}, {arguments:?}: {ended:?}");
            assert!(
                !ended.errors.contains("panicked") && ended.errors.lines().count() <= 3,
                "{what}: {ended:?}"
            );
        }
    }
    // Every kind of damage to a good one: never a panic, never a difference where only bytes were lost.
    let mut state: u64 = 7;
    let mut random = |most: usize| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize % most
    };
    for turn in 0..60 {
        let mut damaged = whole.clone();
        for _ in 0..1 + turn % 4 {
            let place = random(damaged.len());
            match turn % 3 {
                0 => damaged[place] ^= 1 << random(8),
                1 => damaged.truncate(place.max(9)),
                _ => damaged[place..].iter_mut().take(9).for_each(|byte| *byte = 0xff),
            }
        }
        fs::write(&log, damaged).unwrap();
        let ended = delmpc(&["replay", &out, "--verify"]);
        assert!(matches!(ended.status, Some(0 | 2)), "turn {turn}: {ended:?}");
        let ended = delmpc(&["report", &out]);
        assert!(matches!(ended.status, Some(0 | 2)), "turn {turn}: {ended:?}");
    }
}
