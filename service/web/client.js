import{a,b}from"./chunk-7NDZUIQB.js";export{b as Client,a as ServiceError};
