//! A warm exchange allocates nothing, on any link and through any wrapper, but for the written budget of sending over shared memory.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // helpers of tests, too

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use delmpc_messages::{Command, PlantState};
use delmpc_transport::{
    Channel, Delay, Fault, FaultInjector, Lossy, Publisher, Record, Replay, RunId, RunNode, Schedule,
    SharedPublisher, Subscriber, in_process_link, remove_leftovers,
};

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
    static LIVE: Cell<i64> = const { Cell::new(0) };
}

/// The system's allocator, counting each thread's calls and what is alive.
struct Counting;

// SAFETY: every call goes to the system's allocator unchanged; counting touches thread-local numbers and does not allocate.
#[allow(unsafe_code)]
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
        LIVE.set(LIVE.get() + 1);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        LIVE.set(LIVE.get() - 1);
        // SAFETY: the pointer came from `alloc` above, that is from the system's allocator, with this layout.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const WARM_UP: u64 = 10;
const CYCLES: u64 = 1_000;

/// Allocations of `CYCLES` cycles after warm-up.
fn allocations(mut cycle: impl FnMut(u64)) -> u64 {
    (0..WARM_UP).for_each(&mut cycle);
    let before = ALLOCATIONS.get();
    (WARM_UP..WARM_UP + CYCLES).for_each(&mut cycle);
    ALLOCATIONS.get() - before
}

fn state() -> PlantState {
    PlantState::new(1, 2, 30)
}

#[test]
fn the_counter_counts() {
    assert_eq!(allocations(|_| drop(std::hint::black_box(Box::new(1)))), CYCLES);
}

#[test]
fn shared_memory() {
    let run = RunId::random().unwrap();
    let node = RunNode::open(run, 2).unwrap();
    let mut states_out = node.publisher::<PlantState>(Channel::State).unwrap();
    let mut states_in = node.subscriber::<PlantState>(Channel::State).unwrap();
    let mut commands_out = node.publisher::<Command>(Channel::Command).unwrap();
    let mut commands_in = node.subscriber::<Command>(Channel::Command).unwrap();
    let (mut state, mut command) = (state(), Command::new(1, 2, 30));
    let (mut sends, mut sending, mut live) = (0, 0, 0);
    let total = allocations(|cycle| {
        if cycle == WARM_UP {
            (sends, sending, live) = (0, 0, LIVE.get());
        }
        let before = ALLOCATIONS.get();
        state.header.sequence = cycle;
        states_out.send(&state).unwrap();
        commands_out.send(&command).unwrap();
        (sends, sending) = (sends + 2, sending + ALLOCATIONS.get() - before);

        states_out.serve_newcomers().unwrap();
        command.state_sequence = states_in.receive_latest().unwrap().unwrap().header.sequence;
        assert!(commands_in.receive_latest().unwrap().is_some());
        assert!(commands_in.receive_latest().unwrap().is_none());
    });
    live -= LIVE.get();
    drop((states_out, states_in, commands_out, commands_in, node));
    remove_leftovers(run).unwrap();
    assert_eq!(total - sending, 0, "receiving allocates");
    assert!(
        sending <= sends * SharedPublisher::<PlantState>::ALLOCATIONS_PER_SEND,
        "{sending} in {sends} sends"
    );
    assert_eq!(live, 0, "what a send allocates is freed when it returns");
}

#[test]
fn in_process_through_every_wrapper() {
    let (mut publisher, subscriber) = in_process_link::<PlantState>();
    let lossy = Lossy::new(subscriber, Schedule::random(0.2, 1));
    let faulty = FaultInjector::new(lossy, Fault::NotANumber, Schedule::random(0.2, 2), 3);
    let delayed = Delay::in_cycles(faulty, 2).with_jitter(5, 4);
    let mut link = Record::new(delayed, std::io::sink());
    let mut state = state();
    let counted = allocations(|cycle| {
        state.header.sequence = cycle;
        publisher.send(&state).unwrap();
        if let Some(received) = link.receive_latest().unwrap() {
            let _refused_or_not = received.validate(2, 30);
        }
    });
    assert_eq!(counted, 0);
}

#[test]
fn replay() {
    let (publisher, _subscriber) = in_process_link::<PlantState>();
    let mut recorded = Record::new(publisher, Vec::new());
    for _ in 0..WARM_UP + CYCLES {
        recorded.send(&state()).unwrap();
    }
    let file = recorded.finish().unwrap().1;
    let mut replay = Replay::<PlantState, _>::new(file.as_slice()).unwrap();
    assert_eq!(allocations(|_| assert!(replay.receive_latest().unwrap().is_some())), 0);
}
