//! Typed outputs and inputs of stages.
use std::any::Any;
use std::marker::PhantomData;
use std::sync::Arc;

/// An output as graphs pass it on.
pub(super) type Value = Arc<dyn Any + Send + Sync>;

/// What a stage of a graph will make.
pub struct Output<T> {
    pub(super) node: usize,
    pub(super) made: PhantomData<fn() -> T>,
}

impl<T> Clone for Output<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Output<T> {}

/// Tuples of [`Output`]s.
pub trait Inputs {
    /// References to what was made.
    type Values<'v>;
    /// The stages that make them.
    fn nodes(&self) -> Vec<usize>;
    /// What was made, in the order of [`Inputs::nodes`]; `None` if that is something else.
    fn values(made: &[Value]) -> Option<Self::Values<'_>>;
}

macro_rules! inputs {
    ($($name:ident $at:tt),*) => {
        impl<$($name: Send + Sync + 'static),*> Inputs for ($(Output<$name>,)*) {
            type Values<'v> = ($(&'v $name,)*);
            fn nodes(&self) -> Vec<usize> {
                vec![$(self.$at.node),*]
            }
            fn values(_made: &[Value]) -> Option<Self::Values<'_>> {
                Some(($(_made.get($at)?.downcast_ref::<$name>()?,)*))
            }
        }
    };
}

inputs!();
inputs!(A 0);
inputs!(A 0, B 1);
inputs!(A 0, B 1, C 2);
inputs!(A 0, B 1, C 2, D 3);

impl<T> Output<T> {
    /// For [`super::Graph::run`].
    pub fn target(self) -> usize {
        self.node
    }
}
