//! Runs the tasks of one radio thread: host stacks, tags, the medium.
//!
//! Tasks are polled in the order in which they were woken, so that on virtual time a run is a
//! function of its inputs alone. On real time the thread sleeps until a timer is due or another
//! thread (a socket's reader) wakes a task.

use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};
use std::future::Future;
use std::pin::{Pin, pin};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Wake, Waker};
use std::thread::Thread;
use std::time::Duration;

use crate::time;

type Task = Pin<Box<dyn Future<Output = ()>>>;

/// Nothing is left that could ever wake the future that was waited for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the radio waits for something that can never happen")]
pub struct Stalled;

/// Who was woken and waits for its turn.
struct Ready {
    queue: Mutex<VecDeque<u64>>,
    thread: Thread,
}

struct TaskWaker {
    id: u64,
    queued: AtomicBool,
    ready: Arc<Ready>,
}

impl Wake for TaskWaker {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        if !self.queued.swap(true, Ordering::AcqRel) {
            self.ready.queue.lock().unwrap_or_else(PoisonError::into_inner).push_back(self.id);
            self.ready.thread.unpark();
        }
    }
}

struct Slot {
    /// Absent while the task is being polled.
    task: Option<Task>,
    waker: Arc<TaskWaker>,
}

/// The tasks of one thread. Must be used on the thread that made it.
pub struct Executor {
    tasks: RefCell<BTreeMap<u64, Slot>>,
    next: RefCell<u64>,
    ready: Arc<Ready>,
}

impl Default for Executor {
    fn default() -> Self {
        Executor {
            tasks: RefCell::default(),
            next: RefCell::new(0),
            ready: Arc::new(Ready { queue: Mutex::default(), thread: std::thread::current() }),
        }
    }
}

impl Executor {
    /// An executor without tasks.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a task. It runs whenever the executor does; when it ends, it is dropped.
    pub fn spawn(&self, task: impl Future<Output = ()> + 'static) -> TaskId {
        let waker = self.waker();
        let id = waker.id;
        self.tasks
            .borrow_mut()
            .insert(id, Slot { task: Some(Box::pin(task)), waker: waker.clone() });
        waker.wake();
        TaskId(id)
    }

    /// Drops a task where it stands, as a power cut does.
    pub fn kill(&self, TaskId(id): TaskId) {
        // Dropped after the borrow: the task's own drop may wake others.
        let _task = self.tasks.borrow_mut().remove(&id);
    }

    /// Runs everything up to and including `end`, where virtual time then stands. On real time this
    /// takes until `end`.
    pub fn run_until(&self, end: Duration) {
        loop {
            self.run_ready();
            match time::next_timer().filter(|at| *at <= end) {
                Some(at) => self.wait_until(Some(at)),
                None if time::is_virtual() => {
                    time::advance_to(end);
                    return;
                }
                None if time::now() >= end => return,
                None => self.wait_until(Some(end)),
            }
        }
    }

    /// Runs everything for as long as a condition, asked whenever all tasks wait, holds.
    pub fn run_while(&self, mut condition: impl FnMut() -> bool) -> Result<(), Stalled> {
        loop {
            self.run_ready();
            if !condition() {
                return Ok(());
            }
            let timer = time::next_timer();
            if timer.is_none() && time::is_virtual() {
                return Err(Stalled);
            }
            self.wait_until(timer);
        }
    }

    /// Runs everything until `future` is done.
    pub fn block_on<F: Future>(&self, future: F) -> Result<F::Output, Stalled> {
        let mut future = pin!(future);
        let waker = self.waker();
        waker.queued.store(true, Ordering::Release);
        let own = Waker::from(waker.clone());
        let mut woken = true;
        loop {
            if woken {
                waker.queued.store(false, Ordering::Release);
                if let Poll::Ready(output) = future.as_mut().poll(&mut Context::from_waker(&own)) {
                    return Ok(output);
                }
            }
            woken = self.run_ready_until(Some(waker.id));
            if woken {
                continue;
            }
            let timer = time::next_timer();
            if timer.is_none() && time::is_virtual() {
                return Err(Stalled);
            }
            self.wait_until(timer);
        }
    }

    fn waker(&self) -> Arc<TaskWaker> {
        let mut next = self.next.borrow_mut();
        *next += 1;
        Arc::new(TaskWaker { id: *next, queued: AtomicBool::new(false), ready: self.ready.clone() })
    }

    fn run_ready(&self) {
        self.run_ready_until(None);
    }

    /// Polls woken tasks until none is left (false) or it is `stop`'s turn (true).
    fn run_ready_until(&self, stop: Option<u64>) -> bool {
        while let Some(id) = self.pop() {
            if Some(id) == stop {
                return true;
            }
            let Some((mut task, waker)) = self.take(id) else { continue };
            waker.queued.store(false, Ordering::Release);
            let done = task.as_mut().poll(&mut Context::from_waker(&Waker::from(waker))).is_ready();
            let mut tasks = self.tasks.borrow_mut();
            if done {
                tasks.remove(&id);
            } else if let Some(slot) = tasks.get_mut(&id) {
                slot.task = Some(task);
            }
        }
        false
    }

    fn pop(&self) -> Option<u64> {
        self.ready.queue.lock().unwrap_or_else(PoisonError::into_inner).pop_front()
    }

    fn take(&self, id: u64) -> Option<(Task, Arc<TaskWaker>)> {
        let mut tasks = self.tasks.borrow_mut();
        let slot = tasks.get_mut(&id)?;
        Some((slot.task.take()?, slot.waker.clone()))
    }

    /// Lets time pass until `timer` (for ever without one), or until a task is woken from outside.
    fn wait_until(&self, timer: Option<Duration>) {
        if time::is_virtual() {
            timer.into_iter().for_each(time::advance_to);
        } else {
            match timer {
                Some(at) => std::thread::park_timeout(at.saturating_sub(time::now())),
                None => std::thread::park(),
            }
        }
        time::fire();
    }
}

/// A task of an [`Executor`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TaskId(u64);

#[cfg(test)]
mod tests {
    use super::*;
    use embassy_time::{Duration as Ticks, Instant, Timer};
    use std::rc::Rc;

    #[test]
    fn virtual_time_jumps_from_timer_to_timer() {
        time::use_virtual(Duration::from_secs(5));
        let executor = Executor::new();
        let log = Rc::new(RefCell::new(Vec::new()));
        for (name, step) in [("a", 300), ("b", 200)] {
            let log = log.clone();
            executor.spawn(async move {
                for _ in 0..3 {
                    Timer::after(Ticks::from_secs(step)).await;
                    log.borrow_mut().push((name, Instant::now().as_secs()));
                }
            });
        }
        executor.run_until(Duration::from_secs(605));
        assert_eq!(*log.borrow(), [("b", 205), ("a", 305), ("b", 405), ("a", 605), ("b", 605)]);
        executor.block_on(Timer::after(Ticks::from_secs(1000))).unwrap();
        assert_eq!(log.borrow().len(), 6);
        assert_eq!(time::now(), Duration::from_secs(1605));
    }

    #[test]
    fn a_wait_for_nothing_is_told() {
        time::use_virtual(Duration::ZERO);
        let executor = Executor::new();
        assert_eq!(executor.block_on(std::future::pending::<()>()), Err(Stalled));
    }

    #[test]
    fn real_time_waits_and_other_threads_wake() {
        let executor = Executor::new();
        let start = std::time::Instant::now();
        executor.block_on(Timer::after(Ticks::from_millis(20))).unwrap();
        assert!(start.elapsed() >= Duration::from_millis(20));
        let mut asked = false;
        let woken = std::future::poll_fn(|cx| {
            if std::mem::replace(&mut asked, true) {
                return Poll::Ready(());
            }
            let waker = cx.waker().clone();
            std::thread::spawn(move || waker.wake());
            Poll::Pending
        });
        executor.block_on(woken).unwrap();
    }
}
