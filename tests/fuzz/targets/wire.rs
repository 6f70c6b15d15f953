//! Every message from arbitrary bytes: refused, or accepted and then the same bytes again when it is sent; never an
//! allocation, and everything that can be asked of an accepted message makes sense.
#![no_main]

use libfuzzer_sys::fuzz_target;
use teleop_common::authority::Latch;
use teleop_common::hand::JointVector;
use teleop_common::wire::{
    Checked, ControlMessage, HealthMessage, JointStateMessage, MAX_MESSAGE, MappingMessage, Message, PoseMessage,
    Request, decode, encode_into,
};
use teleop_fuzz::{brief, without_allocating};

fuzz_target!(|bytes: &[u8]| {
    if let Some(pose) = accepted::<PoseMessage>(bytes) {
        pose.pose().validate().expect("an accepted pose is one");
        assert!(pose.intent().operator.is_valid());
    }
    if let Some(state) = accepted::<JointStateMessage>(bytes) {
        let finite = |values: &JointVector| values.len() == state.joint_count() && values.is_finite();
        assert!([state.q(), state.dq(), state.tau(), state.q_command()].iter().all(finite));
        assert!(state.mode().is_some());
    }
    if let Some(mapping) = accepted::<MappingMessage>(bytes) {
        assert!(mapping.q_joint().is_finite());
        for finger in mapping.fingers() {
            let signals = finger.signals().expect("an accepted finger is one");
            assert!(signals.p.iter().chain(&signals.p_cartesian).all(|value| value.is_finite()));
        }
    }
    if let Some(health) = accepted::<HealthMessage>(bytes) {
        assert!(health.mode().is_some());
    }
    if let Some(control) = accepted::<ControlMessage>(bytes) {
        let stopped = Latch { asked: 7, reset: 6 };
        match control.request().expect("an accepted request is one") {
            Request::Stop => assert_eq!(stopped.stop(), stopped),
            Request::Reset { stop } => assert_eq!(stopped.reset(stop).is_stopped(), stop != 7),
        }
    }
});

fn accepted<M: Message>(bytes: &[u8]) -> Option<Checked<M>> {
    let message = match without_allocating(|| decode::<M>(bytes)) {
        Ok(message) => message,
        Err(error) => {
            brief(&error);
            return None;
        }
    };
    let mut buffer = [0; MAX_MESSAGE];
    let length = without_allocating(|| encode_into(&*message, &mut buffer)).expect("what is accepted can be sent");
    assert_eq!(&buffer[..length], bytes);
    Some(message)
}
