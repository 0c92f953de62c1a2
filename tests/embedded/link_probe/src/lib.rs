//! Links the no_std crates the way a microcontroller would: no standard library, an allocator that works for constructors only.
//!
//! `cargo build --release` here is the test. It fails with a duplicate `panic_impl` when a crate pulls in the standard library. The
//! functions below are what a firmware would call: make everything once, then `delmpc_probe_cycle` for ever. After the constructors the
//! allocator is sealed, a later request fails and ends in the panic handler. `main.c` calls them on the host.
#![no_std]

use core::alloc::{GlobalAlloc, Layout};
use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

extern crate alloc;
use alloc::boxed::Box;

use delmpc_mechanics::prelude::*;
use delmpc_messages::{Command, Heartbeat, PlantState, Role};

/// Memory of the constructors, bytes. A small robot's workspaces take about a tenth of it.
const ARENA: usize = 1 << 20;
const LINKS: usize = 6;

#[repr(align(64))]
struct Arena(UnsafeCell<[u8; ARENA]>);

/// Hands out memory from the front of an arena and takes none back; refuses once sealed.
struct ConstructorsOnly {
    arena: Arena,
    used: AtomicUsize,
    sealed: AtomicBool,
}

// SAFETY: every byte of the arena is handed out at most once, because `used` only grows, atomically.
unsafe impl Sync for ConstructorsOnly {}

// SAFETY: blocks lie inside the arena, are aligned as asked (the arena itself is aligned to 64 bytes, more is refused) and disjoint.
unsafe impl GlobalAlloc for ConstructorsOnly {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if self.sealed.load(Ordering::Relaxed) || layout.align() > 64 {
            return core::ptr::null_mut();
        }
        let mut used = self.used.load(Ordering::Relaxed);
        loop {
            let start = used.next_multiple_of(layout.align());
            let Some(end) = start.checked_add(layout.size()).filter(|end| *end <= ARENA) else {
                return core::ptr::null_mut();
            };
            match self.used.compare_exchange_weak(used, end, Ordering::Relaxed, Ordering::Relaxed) {
                // SAFETY: `start` is inside the arena.
                Ok(_) => return unsafe { self.arena.0.get().cast::<u8>().add(start) },
                Err(now) => used = now,
            }
        }
    }
    unsafe fn dealloc(&self, _: *mut u8, _: Layout) {}
}

#[global_allocator]
static MEMORY: ConstructorsOnly = ConstructorsOnly {
    arena: Arena(UnsafeCell::new([0; ARENA])),
    used: AtomicUsize::new(0),
    sealed: AtomicBool::new(false),
};

/// A firmware would stop its motors here.
#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    unsafe extern "C" {
        fn delmpc_probe_panicked() -> !;
    }
    // SAFETY: provided by whoever links the library; takes nothing and does not return.
    unsafe { delmpc_probe_panicked() }
}

/// Everything one control loop owns.
pub struct Probe {
    tree: KinematicTree,
    integrator: Integrator,
    linearizer: Linearizer,
    state: State,
    torque: [f64; LINKS],
    plant_state: PlantState,
    command: Command,
    heartbeat: Heartbeat,
}

fn construct() -> Result<Probe, ModelError> {
    let inertia = Matrix3::from_diagonal(&Vector3::new(0.01, 0.01, 0.001));
    let rod = LinkInertia::new(1.0, Vector3::new(0.0, 0.0, -0.15), inertia);
    let mut builder = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, -9.81));
    let mut parent = None;
    for link in 0..LINKS {
        let axis = if link % 2 == 0 { Vector3::y() } else { Vector3::x() };
        let placement = RigidTransform::from_translation(Vector3::new(0.0, 0.0, -0.3));
        parent = Some(builder.add(Body::new(parent, Joint::revolute(axis, placement), rod)));
    }
    let tree = builder.build()?;
    let integrator = Integrator::new(&tree, &LobattoRule::new(2)?, 0.005, StepOptions::default())?;
    let linearizer = Linearizer::new(&tree, &integrator, StateCoordinates::Velocity, InputHold::Held)?;
    let mut state = State::zeros(&tree);
    state.q.fill(0.2);
    Ok(Probe {
        state,
        integrator,
        linearizer,
        tree,
        torque: [0.0; LINKS],
        plant_state: PlantState::new(1, 2, LINKS as u32),
        command: Command::new(1, 2, LINKS as u32),
        heartbeat: Heartbeat::new(1, 2, Role::Controller, 0),
    })
}

/// Makes everything and seals the allocator. Null when the model is refused.
#[unsafe(no_mangle)]
pub extern "C" fn delmpc_probe_new() -> *mut Probe {
    let Ok(probe) = construct() else { return core::ptr::null_mut() };
    let probe = Box::into_raw(Box::new(probe));
    MEMORY.sealed.store(true, Ordering::Relaxed);
    probe
}

/// Memory taken by the constructors, bytes.
#[unsafe(no_mangle)]
pub extern "C" fn delmpc_probe_memory() -> usize {
    MEMORY.used.load(Ordering::Relaxed)
}

/// One cycle: check the messages, step, linearise. Returns `A[0,0]` of the step, NaN on an error.
///
/// # Safety
/// `probe` must come from [`delmpc_probe_new`] and not be in use by another call.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn delmpc_probe_cycle(probe: *mut Probe) -> f64 {
    // SAFETY: the caller's promise.
    let Some(probe) = (unsafe { probe.as_mut() }) else { return f64::NAN };
    let checked = probe.plant_state.validate(2, LINKS).is_ok()
        && probe.command.validate(2, LINKS).is_ok()
        && probe.heartbeat.validate(2).is_ok();
    if !checked {
        return f64::NAN;
    }
    let forces = StepForces::held(&probe.torque);
    if probe.integrator.step(&probe.tree, &mut probe.state, &forces).is_err() {
        return f64::NAN;
    }
    match probe.linearizer.linearize(&probe.tree, &mut probe.integrator) {
        Ok(step) => step.a(0, 0),
        Err(_) => f64::NAN,
    }
}

/// The leak that check.sh must find.
#[cfg(feature = "leak")]
#[unsafe(no_mangle)]
pub extern "C" fn delmpc_probe_leak() -> *mut u8 {
    unsafe extern "C" {
        fn malloc(size: usize) -> *mut u8;
    }
    // SAFETY: malloc takes any size.
    unsafe { malloc(1) }
}
