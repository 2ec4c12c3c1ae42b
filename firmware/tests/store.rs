//! What a tag keeps survives a power cut at every single step of writing it.
#![allow(clippy::unwrap_used)] // Outside of #[test] functions too: a test that cannot go on fails.

use std::cell::RefCell;
use std::rc::Rc;

use embedded_storage_async::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use trouble_host::connection::SecurityLevel;
use trouble_host::{Address, BondInformation, Identity, LongTermKey};
use vergence_air::Executor;
use vergence_firmware::store::{BONDS, Store};

const BLOCK: usize = 4096;
const BLOCKS: usize = 3;

/// A flash whose power fails after a number of steps: a word written, or half of a block erased.
#[derive(Clone)]
struct Flash {
    bytes: Rc<RefCell<Vec<u8>>>,
    steps_left: Rc<RefCell<usize>>,
}

#[derive(Debug)]
struct Dead;

impl NorFlashError for Dead {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl Flash {
    fn new() -> Self {
        Flash {
            bytes: Rc::new(RefCell::new(vec![0xFF; BLOCKS * BLOCK])),
            steps_left: Rc::new(RefCell::new(usize::MAX)),
        }
    }

    fn step(&self) -> Result<(), Dead> {
        let mut left = self.steps_left.borrow_mut();
        *left = left.checked_sub(1).ok_or(Dead)?;
        Ok(())
    }

    fn store(&self) -> Store<Flash> {
        Store::new(self.clone(), 0..(BLOCKS * BLOCK) as u32).unwrap()
    }
}

impl ErrorType for Flash {
    type Error = Dead;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Dead> {
        let from = offset as usize;
        bytes.copy_from_slice(&self.bytes.borrow()[from..from + bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        BLOCKS * BLOCK
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = BLOCK;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), Dead> {
        for half in (from as usize..to as usize).step_by(BLOCK / 2) {
            self.step()?;
            self.bytes.borrow_mut()[half..half + BLOCK / 2].fill(0xFF);
        }
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Dead> {
        for (word, at) in bytes.chunks(4).zip((offset as usize..).step_by(4)) {
            self.step()?;
            let mut flash = self.bytes.borrow_mut();
            flash[at..at + 4].iter_mut().zip(word).for_each(|(cell, byte)| *cell &= byte);
        }
        Ok(())
    }
}

fn run<T>(future: impl Future<Output = T>) -> T {
    Executor::new().block_on(future).unwrap()
}

fn record(store: &mut Store<Flash>) -> Vec<u8> {
    let mut out = [0; 1024];
    let length = run(store.record(&mut out)).unwrap().unwrap();
    out[..length].to_vec()
}

#[test]
fn a_power_cut_at_any_step_loses_no_record() {
    let mut cuts = 0;
    // Enough writes to go round the flash, so that blocks are erased and items moved.
    for round in 0..24u8 {
        let flash = Flash::new();
        let bytes = |k: u8| vec![k; 500 + usize::from(k)];
        for k in 0..=round {
            run(flash.store().set_record(&bytes(k))).unwrap();
        }
        let before = flash.bytes.borrow().clone();
        for steps in 0.. {
            *flash.bytes.borrow_mut() = before.clone();
            *flash.steps_left.borrow_mut() = steps;
            let written = run(flash.store().set_record(&bytes(round + 1)));
            *flash.steps_left.borrow_mut() = usize::MAX;
            let found = record(&mut flash.store());
            if written.is_ok() {
                assert_eq!(found, bytes(round + 1));
                break;
            }
            cuts += 1;
            let whole = [bytes(round), bytes(round + 1)].contains(&found);
            assert!(whole, "round {round}, cut after {steps} steps: {found:?}");
            // And the next write succeeds.
            run(flash.store().set_record(&bytes(99))).unwrap();
            assert_eq!(record(&mut flash.store()), bytes(99), "round {round}, {steps} steps");
        }
    }
    assert!(cuts > 3000, "{cuts} cuts");
}

fn bond(number: u8) -> BondInformation {
    let identity = Identity { addr: Address::random([number, 1, 2, 3, 4, 0xC0]), irk: None };
    let key = LongTermKey::from_le_bytes([number; 16]);
    BondInformation::new(identity, key, SecurityLevel::EncryptedAuthenticated, true)
}

#[test]
fn bonds_are_kept_and_the_oldest_makes_room() {
    let flash = Flash::new();
    let bonds = |flash: &Flash| {
        let mut store = flash.store();
        let mut found: Vec<u8> = (0..BONDS)
            .filter_map(|k| run(store.bond(k)).unwrap())
            .map(|bond| bond.ltk.to_le_bytes()[0])
            .collect();
        found.sort();
        found
    };
    run(flash.store().set_record(&[7; 100])).unwrap();
    for number in 1..=8 {
        run(flash.store().add_bond(&bond(number))).unwrap();
    }
    assert_eq!(bonds(&flash), [1, 2, 3, 4, 5, 6, 7, 8]);
    run(flash.store().add_bond(&bond(5))).unwrap();
    assert_eq!(bonds(&flash), [1, 2, 3, 4, 5, 6, 7, 8], "a known peer takes its own place");
    run(flash.store().add_bond(&bond(9))).unwrap();
    assert_eq!(bonds(&flash), [2, 3, 4, 5, 6, 7, 8, 9]);
    assert_eq!(run(flash.store().bond(1)).unwrap(), Some(bond(2)));
    assert!(
        run(flash.store().holds(&bond(9))).unwrap() && !run(flash.store().holds(&bond(1))).unwrap()
    );
    run(flash.store().forget_bonds()).unwrap();
    assert_eq!(bonds(&flash), Vec::<u8>::new());
    assert_eq!(record(&mut flash.store()), [7; 100]);
}

#[test]
fn a_bond_without_proof_costs_no_bond_with_it() {
    let store = &mut Flash::new().store();
    let weak = |number: u8| BondInformation {
        security_level: SecurityLevel::Encrypted,
        ltk: LongTermKey::from_le_bytes([100 + number; 16]),
        ..bond(number)
    };
    let mut add = |bond: BondInformation| {
        let kept = run(store.add_bond(&bond)).unwrap();
        assert_eq!(run(store.holds(&bond)).unwrap(), kept);
        let keys = (0..BONDS).filter_map(|k| run(store.bond(k)).unwrap());
        let mut keys: Vec<u8> = keys.map(|bond| bond.ltk.to_le_bytes()[0]).collect();
        keys.sort();
        (kept, keys)
    };
    assert_eq!(add(bond(1)), (true, vec![1]));
    assert_eq!(add(weak(1)), (false, vec![1]), "under the address of a robot that proved itself");
    assert_eq!(add(weak(2)), (true, vec![1, 102]));
    assert_eq!(add(bond(2)), (true, vec![1, 2]), "a robot that proves itself later");
    for number in 3..=5 {
        add(weak(number));
    }
    for number in 6..=8 {
        add(bond(number));
    }
    assert_eq!(add(weak(9)), (true, vec![1, 2, 6, 7, 8, 104, 105, 109]), "3 was the oldest weak");
    assert_eq!(add(bond(10)), (true, vec![1, 2, 6, 7, 8, 10, 105, 109]), "4 was the next");
    add(bond(11));
    assert_eq!(add(bond(12)), (true, vec![1, 2, 6, 7, 8, 10, 11, 12]));
    assert_eq!(add(weak(13)), (false, vec![1, 2, 6, 7, 8, 10, 11, 12]));
    assert_eq!(add(bond(14)), (true, vec![2, 6, 7, 8, 10, 11, 12, 14]), "1 was the oldest");
}

#[test]
fn a_flash_that_was_never_written_holds_nothing() {
    let mut store = Flash::new().store();
    assert_eq!(run(store.record(&mut [0; 1024])).unwrap(), None);
    assert_eq!(run(store.bond(0)).unwrap(), None);
    assert!(Store::new(Flash::new(), 0..BLOCK as u32).is_err(), "one block is too little");
}
