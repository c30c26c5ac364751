//! Priorities, processors and memory that stays, asked for from the kernel. What it refuses is a reason
//! for a warning, never for an end.
#![expect(unsafe_code, reason = "calls of the system")]

use rustix::mm::{MlockAllFlags, mlockall};
use rustix::thread::{CpuSet, sched_setaffinity};

/// Runs `work`; threads that it starts take frames before everything that is not real-time. The calling
/// thread is an ordinary one again afterwards.
///
/// # Errors
/// In the second place: the kernel refuses the priority, and all threads are ordinary ones.
pub fn with_priority<R>(priority: u32, work: impl FnOnce() -> R) -> (R, Result<(), String>) {
    if priority == 0 {
        return (work(), Ok(()));
    }
    let raised = set_policy(libc::SCHED_FIFO, priority).map_err(|e| {
        format!("real-time priority {priority} is refused: {e}: see LimitRTPRIO= of the unit, or rtprio in limits.conf")
    });
    let result = work();
    // Lowering takes no privilege.
    let lowered = raised.is_ok().then(|| set_policy(libc::SCHED_OTHER, 0));
    if let Some(Err(cause)) = lowered {
        tracing::warn!(%cause, "the main thread keeps its real-time priority");
    }
    (result, raised)
}

/// The policy of the calling thread, which those that it starts inherit.
fn set_policy(policy: libc::c_int, priority: u32) -> std::io::Result<()> {
    // SAFETY: a plain C struct, for which zeros are a valid value.
    let mut param: libc::sched_param = unsafe { std::mem::zeroed() };
    param.sched_priority = libc::c_int::try_from(priority).unwrap_or(0);
    // SAFETY: the struct lives during the call; 0 is the calling thread.
    match unsafe { libc::sched_setscheduler(0, policy, &raw const param) } {
        0 => Ok(()),
        _ => Err(std::io::Error::last_os_error()),
    }
}

/// Keeps all memory, now and later, from being paged out.
///
/// # Errors
/// The kernel refuses.
pub fn lock_memory() -> Result<(), String> {
    mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE).map_err(|e| {
        format!(
            "memory cannot be locked: {e}: see LimitMEMLOCK= of the unit, or memlock in limits.conf"
        )
    })
}

/// Binds this thread, and those that it starts, to some processors; none: to all.
///
/// # Errors
/// The kernel refuses: none of them is there.
pub fn bind(processors: &[usize]) -> Result<(), String> {
    if processors.is_empty() {
        return Ok(());
    }
    let mut set = CpuSet::new();
    for processor in processors {
        if *processor < CpuSet::MAX_CPU {
            set.set(*processor);
        }
    }
    sched_setaffinity(None, &set)
        .map_err(|e| format!("the processors {processors:?} cannot be bound to: {e}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn policy() -> libc::c_int {
        // SAFETY: no memory is passed; 0 is the calling thread.
        unsafe { libc::sched_getscheduler(0) }
    }

    /// On a thread of its own, so that no other test is bound.
    fn alone<R: Send + 'static>(work: impl FnOnce() -> R + Send + 'static) -> R {
        std::thread::spawn(work).join().expect("no panic")
    }

    #[test]
    fn threads_inherit_the_priority_and_the_caller_loses_it() {
        alone(|| {
            let (inside, granted) =
                with_priority(10, || std::thread::spawn(policy).join().expect("no panic"));
            let expected = match &granted {
                Ok(()) => libc::SCHED_FIFO,
                Err(why) => {
                    assert!(why.contains("real-time priority 10 is refused"), "{why}");
                    libc::SCHED_OTHER
                }
            };
            assert_eq!(inside, expected);
            assert_eq!(policy(), libc::SCHED_OTHER);
        });
    }

    #[test]
    fn no_priority_changes_nothing() {
        alone(|| {
            let before = policy();
            let (inside, granted) = with_priority(0, policy);
            assert_eq!((inside, granted), (before, Ok(())));
        });
    }

    #[test]
    fn processors_that_are_not_there_are_an_error_and_others_are_bound_to() {
        alone(|| {
            let own = rustix::thread::sched_getaffinity(None).expect("readable");
            let first = (0..CpuSet::MAX_CPU).find(|n| own.is_set(*n)).expect("one");
            assert_eq!(bind(&[first]), Ok(()));
            let bound = rustix::thread::sched_getaffinity(None).expect("readable");
            assert_eq!(bound.count(), 1);
            assert!(bind(&[1023]).is_err_and(|why| why.contains("1023")));
        });
    }
}
