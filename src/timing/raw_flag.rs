//! Two numbers in a page of memory that two processes share: the fastest way one can tell the other anything, the floor of every transport.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::ptr::NonNull;
use std::sync::atomic::{AtomicU64, Ordering};

use rustix::fs::{FallocateFlags, fallocate};
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};

/// The page: a number that goes to the peer and one that comes back, each on cache lines of its own.
const PAGE: usize = 4096;
/// Neighbouring lines are fetched in pairs: far enough apart.
const BACK: usize = 256;

/// A flag between two processes.
#[derive(Debug)]
pub struct RawFlag {
    page: NonNull<u8>,
    /// Removed with the flag by the side that made it.
    file: Option<PathBuf>,
}

impl RawFlag {
    /// Makes the file, in shared memory, and maps it.
    ///
    /// # Errors
    /// When there is no shared memory.
    pub fn create(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(path)?;
        // Taken from the file system now: where it is full, touching the page would end the process.
        match fallocate(&file, FallocateFlags::empty(), 0, PAGE as u64)
            .map_err(io::Error::from)
            .and_then(|()| map(&file))
        {
            Ok(page) => Ok(Self { page, file: Some(path.to_owned()) }),
            Err(error) => {
                let _ = fs::remove_file(path);
                Err(error)
            }
        }
    }

    /// Maps a flag somebody else made.
    ///
    /// # Errors
    /// When it is not there.
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).open(path)?;
        if file.metadata()?.len() < PAGE as u64 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        Ok(Self { page: map(&file)?, file: None })
    }

    /// The number that goes to the peer.
    pub fn out(&self) -> &AtomicU64 {
        self.number(0)
    }

    /// The number that comes back.
    pub fn back(&self) -> &AtomicU64 {
        self.number(BACK)
    }

    #[allow(unsafe_code, reason = "memory shared by processes")]
    fn number(&self, offset: usize) -> &AtomicU64 {
        // SAFETY: `page` is a live mapping of PAGE bytes, `offset` a multiple of 8 within it, and both processes touch these bytes as
        // `AtomicU64` only.
        unsafe { self.page.add(offset).cast::<AtomicU64>().as_ref() }
    }

    /// Answers numbers until one is `last`: the peer's side of a measurement. `false`: `give_up` said so.
    pub fn echo(&self, last: u64, mut give_up: impl FnMut() -> bool) -> bool {
        let mut seen = 0;
        while seen != last {
            let number = self.out().load(Ordering::Acquire);
            if number == seen {
                if give_up() {
                    return false;
                }
                std::hint::spin_loop();
                continue;
            }
            seen = number;
            self.back().store(number, Ordering::Release);
        }
        true
    }
}

impl Drop for RawFlag {
    #[allow(unsafe_code, reason = "memory shared by processes")]
    fn drop(&mut self) {
        // SAFETY: the mapping is ours, PAGE long, and nothing borrowed from it outlives `self`.
        let _ = unsafe { munmap(self.page.as_ptr().cast(), PAGE) };
        if let Some(file) = &self.file {
            let _ = fs::remove_file(file);
        }
    }
}

#[allow(unsafe_code, reason = "memory shared by processes")]
fn map(file: &File) -> io::Result<NonNull<u8>> {
    let access = ProtFlags::READ | ProtFlags::WRITE;
    // SAFETY: a new mapping at an address the kernel chooses touches no existing object.
    let page = unsafe { mmap(std::ptr::null_mut(), PAGE, access, MapFlags::SHARED, file, 0) }?;
    NonNull::new(page.cast()).ok_or_else(|| io::ErrorKind::OutOfMemory.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_mappings_of_a_flag_see_the_same_numbers_and_the_file_goes() {
        let path = std::env::temp_dir().join(format!("delmpc-flag-{}", std::process::id()));
        let ours = RawFlag::create(&path).unwrap();
        let theirs = RawFlag::open(&path).unwrap();
        ours.out().store(7, Ordering::Release);
        assert!(theirs.echo(7, || false));
        assert_eq!(ours.back().load(Ordering::Acquire), 7);
        assert!(!theirs.echo(8, || true), "nobody sends 8");
        drop((ours, theirs));
        assert!(RawFlag::open(&path).is_err());
    }
}
